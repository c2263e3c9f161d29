# SPDX-License-Identifier: MIT
"""Compiled functions: cached where they can be, and never the reason for a crash."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from densify import kernels

SOURCE = """
def double(first, last, values, out):
    for i in range(first, last):
        out[i] = 2 * values[i]
"""


@pytest.fixture
def double(tmp_path):
    """A function with a source file of its own."""
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("doubling", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["doubling"] = module
    spec.loader.exec_module(module)
    yield module.double
    del sys.modules["doubling"]


def check(kernel: kernels.Kernel) -> None:
    values = np.arange(1001.0)
    out = np.zeros_like(values)
    kernel.over_rows(len(values), values, out)
    np.testing.assert_array_equal(out, 2 * values)


def test_compiled_code_is_kept(double, tmp_path):
    check(kernels.Kernel(double))
    assert list(tmp_path.rglob("*.nbc"))
    again = kernels.Kernel(double)
    check(again)
    assert sum(again._compiled.stats.cache_hits.values()) == 1


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("content", [b"", b"damaged"])
def test_damaged_caches_do_not_matter(double, tmp_path, suffix, content):
    check(kernels.Kernel(double))
    (kept,) = tmp_path.rglob(f"*.{suffix}")
    kept.write_bytes(content)
    check(kernels.Kernel(double))


def test_a_cache_that_cannot_be_written_does_not_matter(double, tmp_path, monkeypatch):
    kernel = kernels.Kernel(double)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    check(kernel)
    assert not list(tmp_path.rglob("*.nbc"))


def test_without_any_place_for_a_cache():
    namespace: dict = {}
    exec(SOURCE, namespace)  # a function without a source file
    check(kernels.Kernel(namespace["double"]))


@pytest.mark.parametrize("num_rows", [0, 1, 99, 100, 1001])
def test_every_row_is_done_once(double, monkeypatch, num_rows):
    monkeypatch.setattr(kernels, "_MIN_ROWS_PER_THREAD", 50)
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 3)
    values = np.arange(float(num_rows))
    out = np.zeros_like(values)
    kernels.Kernel(double).over_rows(num_rows, values, out)
    np.testing.assert_array_equal(out, 2 * values)
