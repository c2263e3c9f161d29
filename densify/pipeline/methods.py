# SPDX-License-Identifier: MIT
"""The methods of accumulation, by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from densify.config.errors import InputError


class Method(NamedTuple):
    """One method.

    all_sweeps: of the window; else the key sweep alone. engine: of scene flow (``flow.engine``),
    "" for the configured one, None for rigid accumulation. visible: occluded and doubtful points
    are rejected; else each pixel shows its nearest point. far: with static surfaces beyond the
    window (``accumulate.far_m``).
    """

    all_sweeps: bool
    engine: str | None
    visible: bool
    far: bool


METHODS = {
    "none": Method(False, None, False, False),
    "icp": Method(True, None, False, False),
    "icp-far": Method(True, None, False, True),
    "icp-visible": Method(True, None, True, True),
    "flow-plain": Method(True, "", False, False),
    "paper": Method(True, "paper", True, True),
    "flow": Method(True, "", True, True),
}
"""Single sweep; rigid accumulation of the window, with the road beyond it, with visibility; our
scene flow without visibility; the published scene flow; ours."""

RUN = ("none", "icp", "flow")
"""The methods of `run`, each with those before it as its baselines."""
COMPARED = ("none", "icp", "icp-far", "paper", "flow")
"""The methods that `compare` shows by default."""


def with_baselines(method: str) -> tuple[str, ...]:
    """Return a method of `RUN` behind the simpler ones. Raises InputError for another one."""
    if method not in RUN:
        raise InputError(f"--method {method}: expected one of {', '.join(RUN)}")
    return RUN[: RUN.index(method) + 1]


def engines(methods: Sequence[str], configured: str) -> list[str]:
    """Return the engine that each method uses, "" for none. configured: ``flow.engine``."""
    used = [METHODS[name].engine for name in methods if name in METHODS]
    return ["" if engine is None else engine or configured for engine in used]


def looks_around(methods: Sequence[str]) -> bool:
    """Return True if one of the methods finds what moves."""
    return any(METHODS[name].engine is not None for name in methods if name in METHODS)
