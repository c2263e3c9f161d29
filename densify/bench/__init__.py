# SPDX-License-Identifier: MIT
"""Measured tables: this package's methods beside published ones. The pipeline needs none of it."""
