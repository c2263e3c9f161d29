# SPDX-License-Identifier: MIT
"""Measure tables: depth and scene flow of this package and other methods against ground truth."""
