# SPDX-License-Identifier: MIT
"""Engine for whole recordings: track groups of seen-through points as rigid objects."""
