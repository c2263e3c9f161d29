# SPDX-License-Identifier: MIT
"""The built-in street: a lidar and camera simulator with exact truth, made from a seed."""
