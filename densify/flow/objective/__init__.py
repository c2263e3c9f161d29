# SPDX-License-Identifier: MIT
"""Minimise the published scene flow objective of Pontes, Hays, Lucey (3DV 2020)."""
