# SPDX-License-Identifier: MIT
"""Freed memory serves what comes next."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

_PAGES = 64 << 8  # 64 MiB
_FAULTS = f"""
import resource
from concurrent.futures import ThreadPoolExecutor
from densify.pipeline.heap import keep_freed_memory

def faults():
    bytearray({_PAGES} << 12)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

keep_freed_memory()
with ThreadPoolExecutor(1) as pool:
    before = pool.submit(faults).result()
    print(faults() - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library's heap")
def test_an_array_takes_the_place_of_one_freed_by_another_thread() -> None:
    said = subprocess.run([sys.executable, "-c", _FAULTS], capture_output=True, check=True)
    assert int(said.stdout) < _PAGES // 10
