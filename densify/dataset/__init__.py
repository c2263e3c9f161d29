# SPDX-License-Identifier: MIT
"""Make a training set of depth maps from whole recordings, one key sweep after another."""
