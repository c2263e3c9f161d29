# SPDX-License-Identifier: MIT
"""The examples run as they are, and what they print is plausible."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np

EXAMPLES = Path(__file__).parents[1] / "examples"


def output_of(script: str, cwd: Path, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / script), *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def number_before(text: str, words: str) -> float:
    found = re.search(rf"([\d.,]+) ?%? {words}", text)
    assert found, text
    return float(found.group(1).replace(",", ""))


def test_street(tmp_path: Path) -> None:
    text = output_of("street.py", tmp_path, "depth.npy")
    depth_m = np.load(tmp_path / "depth.npy")
    assert depth_m.shape == (375, 1242) and depth_m.dtype == np.float32
    found = re.search(r"median error ([\d.]+) m", text)
    assert found and float(found.group(1)) < 0.1
    assert number_before(text, "points, ") > 300_000
    assert number_before(text, "of them on moving objects") > 0
    assert f"depth in {np.mean(depth_m > 0):.1%} of the pixels" in text


def test_kitti(test_data: Path, tmp_path: Path) -> None:
    drive = test_data / "kitti" / "2011_09_26" / "2011_09_26_drive_0013_sync"
    text = output_of("kitti.py", tmp_path, str(drive), "120")
    assert text.startswith("key 120: sweeps 118 to 122, ")
    assert number_before(text, "points\n") > 5 * 100_000
    assert number_before(text, "points moved") > 100
    assert not list(tmp_path.iterdir())


def test_examples_are_short() -> None:
    for path in EXAMPLES.glob("*.py"):
        code = [line for line in path.read_text("utf-8").splitlines() if line.strip()]
        assert len(code) <= 25, path
