# SPDX-License-Identifier: MIT
"""Estimate scene flow between point clouds. The package itself loads nothing."""
