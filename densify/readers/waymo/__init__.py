# SPDX-License-Identifier: MIT
"""The Waymo Open Dataset, perception, version 2."""
