# SPDX-License-Identifier: MIT
"""Write the files of a result, each whole or absent, their exports and the report page."""
