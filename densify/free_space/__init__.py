# SPDX-License-Identifier: MIT
"""Find free space: range images, the scanner's rays, the space that they passed, and the ground."""
