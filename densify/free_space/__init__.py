# SPDX-License-Identifier: MIT
"""Find free space: range images, the scanners' rays, the space that they passed, the ground."""
