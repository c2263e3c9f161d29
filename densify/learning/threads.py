# SPDX-License-Identifier: MIT
"""Torch on one thread: with more its sums come out otherwise. Other cores make samples or look at
other sweeps meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


def one_thread() -> None:
    """Have the calling thread work alone from now on."""
    torch.set_num_threads(1)


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Inside the block, in the calling thread."""
    before = torch.get_num_threads()
    one_thread()
    try:
        yield
    finally:
        torch.set_num_threads(before)
