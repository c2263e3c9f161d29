# SPDX-License-Identifier: MIT
"""The published objective of Pontes, Hays, Lucey (3DV 2020), and its solvers."""
