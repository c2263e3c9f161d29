# SPDX-License-Identifier: MIT
"""The page about one key: data, script and style in a single file that opens from disk."""
