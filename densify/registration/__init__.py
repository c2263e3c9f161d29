# SPDX-License-Identifier: MIT
"""Estimate the pose of the lidar at every sweep, and remove its motion within a sweep."""
