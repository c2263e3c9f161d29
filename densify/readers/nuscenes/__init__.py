# SPDX-License-Identifier: MIT
"""nuScenes, and TruckScenes in the same tables."""
