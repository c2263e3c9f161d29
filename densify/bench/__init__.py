# SPDX-License-Identifier: MIT
"""Measured tables: this package's depth and scene flow beside other methods and exact truth."""
