# SPDX-License-Identifier: MIT
"""Results as one HTML file each, to be opened in a browser without anything installed."""

from densify.report.write import write_comparison_page, write_output, write_report

__all__ = ["write_comparison_page", "write_output", "write_report"]
