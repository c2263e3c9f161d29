# SPDX-License-Identifier: MIT
"""Any folder of sweeps, and the densify.yaml beside them."""
