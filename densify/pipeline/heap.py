# SPDX-License-Identifier: MIT
"""Set how the C library reuses the memory of freed arrays."""

from __future__ import annotations

import ctypes
from contextlib import suppress

# glibc's mallopt(3)
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_KEPT_BYTES = 2**30
_MOST_OF_OLDER_BYTES = 2**25  # older releases refuse a larger threshold of mmap


def keep_freed_memory() -> None:
    """Let all threads of this process share one heap that keeps the freed memory of large arrays.

    By default each thread has its own heap, and the system takes back and clears the pages of every
    large array. Call this before threads are started. It does nothing if the C library is not
    glibc.
    """
    with suppress(OSError, AttributeError, TypeError):  # another library, or none by that name
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_ARENA_MAX, 1)
        if not mallopt(_MMAP_THRESHOLD, _KEPT_BYTES):
            mallopt(_MMAP_THRESHOLD, _MOST_OF_OLDER_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
