# SPDX-License-Identifier: MIT
"""The results of a key: `densify.results.key` is the story."""
