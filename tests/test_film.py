# SPDX-License-Identifier: MIT
"""The film of a run: a trail becomes a car, then the sweeps come one by one."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.outputs import read_cloud
from densify.outputs.report import film
from tests.command import refused
from tests.report_runs import results, write_run

ORANGE = np.array([0, 159, 230])  # BGR of the first object


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("run"), report=False)


def frames_of(path: Path) -> list[np.ndarray]:
    done, animation = cv2.imreadanimation(str(path))
    assert done
    return [frame[:, :, :3] for frame in animation.frames]


def test_the_trail_collapses_and_sweeps_fill(run: Path) -> None:
    pictures = list(film._pictures(read_cloud(run / "cloud.laz")))
    num_turns, num_sweeps = 16, len(results()["flow"].frames)
    assert len(pictures) == num_turns + 1 + num_sweeps
    bare = [picture[45:].astype(int) for picture, _ in pictures]  # without the title
    length = [
        np.ptp(np.flatnonzero((np.abs(p - ORANGE).max(axis=2) < 40).any(axis=1))) for p in bare
    ]
    assert length[0] > 1.3 * length[num_turns] > 0
    assert all(a >= b - 1 for a, b in pairwise(length[: num_turns + 1]))
    filled = [int((p > 20).any(axis=2).sum()) for p in bare[num_turns + 1 :]]
    assert (np.diff(filled) > 0).all()
    assert np.array_equal(bare[-1], bare[num_turns])  # nothing from beyond the window here
    assert 4 < sum(seconds for _, seconds in pictures) < 12


def test_both_kinds_can_be_played(run: Path, tmp_path: Path, monkeypatch) -> None:
    pictures = list(film._pictures(read_cloud(run / "cloud.laz")))
    monkeypatch.setattr(film, "_pictures", lambda _: pictures)
    for suffix, coarse in ((".gif", 15), (".webp", 6)):  # 256 colours
        path = tmp_path / "new" / f"film{suffix}"
        film.write_film(run, path)
        frames = frames_of(path)
        assert frames[0].shape == pictures[0][0].shape and len(frames) >= 20
        assert np.abs(frames[0].astype(int) - pictures[0][0]).mean() < coarse
        assert path.stat().st_size < 3_000_000


def test_what_cannot_be_filmed(run: Path, tmp_path: Path, capsys) -> None:
    (tmp_path / "there.gif").touch()
    for name, words in (("film.mp4", "ends in .gif or .webp"), ("there.gif", "already there")):
        said = refused(capsys, 2, "run", "--key", 3, "--film", tmp_path / name)
        assert words in said
    said = refused(capsys, 2, "run", "--keys", "3:5", "--film", tmp_path / "film.gif")
    assert "got 2 keys, expected one" in said
