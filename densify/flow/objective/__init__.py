# SPDX-License-Identifier: MIT
"""Minimise the published objective of Pontes, Hays, Lucey (3DV 2020)."""
