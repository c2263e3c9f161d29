# SPDX-License-Identifier: MIT
"""Make depth maps of registered sweeps: accumulation, visibility, fill, colour, age."""
