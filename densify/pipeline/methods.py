# SPDX-License-Identifier: MIT
"""What can be accumulated, by name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from densify.config.errors import InputError


class Method(NamedTuple):
    """What is accumulated. all_sweeps: else the key sweep alone. engine: which flow, see
    ``flow.engine``; None for none, "" for the configured one. visible: what is hidden, vetoed or
    doubtful is left out, else each pixel shows its nearest point. far: with the standing world
    beyond the window (``accumulate.far_m``)."""

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
"""The key sweep alone; registration alone, of the window and of all sweeps within
``accumulate.far_m``; with visibility; our scene flow without visibility; the published scene flow;
ours. `compare` takes any, `run` none, icp and flow."""

RUN = ("none", "icp", "flow")
"""What `run` takes, each with those before it as its baselines."""
COMPARED = ("none", "icp", "icp-far", "paper", "flow")
"""What `compare` shows unless told otherwise."""


def with_baselines(method: str) -> tuple[str, ...]:
    """A method of `RUN` behind the simpler ones. Raises InputError for another one."""
    if method not in RUN:
        raise InputError(f"--method {method}: expected one of {', '.join(RUN)}")
    return RUN[: RUN.index(method) + 1]


def engines(methods: Sequence[str], configured: str) -> list[str]:
    """Which flow each method uses, "" for none. configured: ``flow.engine``."""
    used = [METHODS[name].engine for name in methods if name in METHODS]
    return ["" if engine is None else engine or configured for engine in used]


def looks_around(methods: Sequence[str]) -> bool:
    """Whether one of them asks what moves."""
    return any(METHODS[name].engine is not None for name in methods if name in METHODS)
