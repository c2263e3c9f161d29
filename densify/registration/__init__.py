# SPDX-License-Identifier: MIT
"""Where the lidar was at every sweep, and its own motion within a sweep undone."""
