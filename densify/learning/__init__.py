# SPDX-License-Identifier: MIT
"""Learn scene flow: train a network on clips of recordings, and use it as an engine."""
