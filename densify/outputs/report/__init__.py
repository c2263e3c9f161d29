# SPDX-License-Identifier: MIT
"""Make the page of one key: data, script and style in a single file that opens from disk."""
