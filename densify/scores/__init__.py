# SPDX-License-Identifier: MIT
"""Score depth maps, scene flow and clouds, with and without ground truth."""
