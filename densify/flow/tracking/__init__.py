# SPDX-License-Identifier: MIT
"""The engine for whole recordings: what other sweeps saw through is followed as rigid objects."""
