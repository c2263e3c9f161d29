# SPDX-License-Identifier: MIT
"""Compiled functions: cached where they can be, never the reason for a crash, and shared out among
threads row by row."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest

from densify.geometry import compiled as kernels

SOURCE = """
def double(first, last, values, out):
    for i in range(first, last):
        out[i] = 2 * values[i]
"""


@pytest.fixture
def double(tmp_path, monkeypatch):
    """A function with a source file of its own, and the cache beside it."""
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    path = tmp_path / "doubling.py"
    path.write_text(SOURCE)
    spec = importlib.util.spec_from_file_location("doubling", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["doubling"] = module
    spec.loader.exec_module(module)
    yield module.double
    del sys.modules["doubling"]


def check(kernel: kernels.Kernel, num_rows: int = 1001) -> None:
    values = np.arange(float(num_rows))
    out = np.full_like(values, -1)
    kernel.over_rows(len(values), values, out)
    np.testing.assert_array_equal(out, 2 * values)


def test_compiled_code_is_kept(double, tmp_path):
    check(kernels.Kernel(double))
    assert list(tmp_path.rglob("*.nbc"))
    again = kernels.Kernel(double)
    check(again)
    assert sum(again._compiled.stats.cache_hits.values()) == 1


@pytest.mark.parametrize("name", ["", "kernels"])
def test_code_that_others_could_have_put_there_is_not_loaded(
    name, double, tmp_path, monkeypatch, caplog
):
    folder = tmp_path / "numba"
    monkeypatch.setattr("numba.config.CACHE_DIR", str(folder))
    check(kernels.Kernel(double))
    (own,) = folder.iterdir()
    kept = {path: path.read_bytes() for path in own.iterdir()}
    assert len(kept) == 2 and caplog.records == []
    (own if name else folder).chmod(0o777)
    kernels._is_open.cache_clear()
    again = kernels.Kernel(double)
    check(again)
    assert sum(again._compiled.stats.cache_hits.values()) == 0
    assert {path: path.read_bytes() for path in own.iterdir()} == kept
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "others can write to it" in caplog.text


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_damaged_code_is_compiled_again(suffix, double, tmp_path):
    check(kernels.Kernel(double))
    for path in tmp_path.rglob(f"*{suffix}"):
        path.write_bytes(b"damaged")
    check(kernels.Kernel(double))


def test_code_that_cannot_be_kept_runs(double, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(kernels.FunctionCache, "save_overload", full)
    check(kernels.Kernel(double))


@pytest.fixture
def shared_out(monkeypatch):
    """Three threads for anything worth sharing."""
    monkeypatch.setattr(kernels, "_LEAST_ROWS", 50)
    monkeypatch.setattr(kernels, "num_threads", lambda: 3)


@pytest.mark.parametrize("num_rows", [0, 99, 1001])
def test_a_kernel_does_every_row(double, shared_out, num_rows):
    check(kernels.Kernel(double), num_rows)


@pytest.mark.parametrize("where", ["first", "others"])
def test_errors_come_through_once_all_are_done(shared_out, where):
    done = []

    def fail(begin, end):
        done.append(begin)
        if (begin == 0) == (where == "first"):
            raise ValueError("here")

    with pytest.raises(ValueError, match="here"):
        kernels.Kernel.over_rows(fail, 300)
    assert len(done) == 3
