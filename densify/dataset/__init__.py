# SPDX-License-Identifier: MIT
"""A training set of every key of whole recordings."""
