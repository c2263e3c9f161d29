# SPDX-License-Identifier: MIT
"""Read KITTI and its relatives: raw drives, odometry, tracking, KITTI-360."""
