# SPDX-License-Identifier: MIT
"""Scene flow between any two clouds."""
