# SPDX-License-Identifier: MIT
"""How much memory a piece of work adds to the process, from Linux's own counter."""

from __future__ import annotations

import ctypes
import gc
from pathlib import Path
from typing import NamedTuple

from densify.pipeline.costs import status_mb

_CLEAR_REFS = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"  # proc(5): sets the peak resident set size to the current one


class PeakMemory(NamedTuple):
    """The rise of the process's peak resident memory since `start`, exact to the page.

    What earlier work freed is given back first, as far as the C library can; what it keeps is used
    again without a rise, so this is a lower bound of what the work would need in a process of its
    own. Nothing is known, and None returned, where there is no Linux ``/proc`` that may be written
    to.
    """

    before_mb: float | None

    @staticmethod
    def start() -> PeakMemory:
        gc.collect()
        _give_back()
        try:
            _CLEAR_REFS.write_text(_RESET_PEAK)
            return PeakMemory(status_mb("VmRSS"))
        except OSError:
            return PeakMemory(None)

    def rise_mb(self) -> float | None:
        if self.before_mb is None:
            return None
        peak_mb = status_mb("VmHWM")
        return None if peak_mb is None else max(0.0, peak_mb - self.before_mb)


def _give_back() -> None:
    """Freed memory back to the system, where the C library is glibc."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (OSError, AttributeError, TypeError):  # another C library, or none to load by that name
        return
