# SPDX-License-Identifier: MIT
"""Whole drives into training sets."""
