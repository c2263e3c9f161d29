# SPDX-License-Identifier: MIT
"""KITTI and its relatives: raw drives, odometry, tracking, KITTI-360."""
