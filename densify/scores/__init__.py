# SPDX-License-Identifier: MIT
"""Scores of depth maps, scene flow and clouds, with and without truth."""
