# SPDX-License-Identifier: MIT
"""Read any folder of sweeps, described by an optional ``densify.yaml``."""
