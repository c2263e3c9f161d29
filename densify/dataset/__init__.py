# SPDX-License-Identifier: MIT
"""Make a training set of every key of whole recordings."""
