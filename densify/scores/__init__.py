# SPDX-License-Identifier: MIT
"""How good it is: depth maps, scene flow, ghosts, with and without truth."""
