# SPDX-License-Identifier: MIT
"""From registered sweeps to depth maps: accumulation, visibility, filling, colour, age."""
