# SPDX-License-Identifier: MIT
"""Writes the built-in street in the formats of data sets, with its exact truth."""
