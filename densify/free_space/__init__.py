# SPDX-License-Identifier: MIT
"""Free space: range images, the scanner's rays, what they passed through, and the ground."""
