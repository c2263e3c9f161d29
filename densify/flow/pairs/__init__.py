# SPDX-License-Identifier: MIT
"""Estimate scene flow between any two clouds."""
