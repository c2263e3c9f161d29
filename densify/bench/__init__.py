# SPDX-License-Identifier: MIT
"""Measure tables: depth and scene flow of this package beside other methods and exact truth."""
