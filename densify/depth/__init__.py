# SPDX-License-Identifier: MIT
"""What cameras see of registered sweeps: accumulation, visibility, filling, colour, age."""
