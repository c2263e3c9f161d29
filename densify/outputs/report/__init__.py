# SPDX-License-Identifier: MIT
"""Make the HTML page of one key sweep: a single file with data, script and style."""
