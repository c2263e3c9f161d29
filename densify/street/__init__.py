# SPDX-License-Identifier: MIT
"""The built-in street: a seeded lidar and camera simulator with exact ground truth."""
