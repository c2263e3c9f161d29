# SPDX-License-Identifier: MIT
"""``python -m densify``: the same as the console script ``densify``."""

from __future__ import annotations

from densify.cli import script

script()
