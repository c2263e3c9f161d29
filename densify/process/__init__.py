# SPDX-License-Identifier: MIT
"""What the process takes: seconds and memory of the stages, and how memory is kept."""
