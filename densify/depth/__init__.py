# SPDX-License-Identifier: MIT
"""From registered sweeps to what cameras see: accumulation, visibility, filling, colour, age."""
