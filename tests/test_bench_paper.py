# SPDX-License-Identifier: MIT
"""The paper's tables: scores by hand, sets of others as files, and the command."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from densify.bench import paper
from densify.bench.paper import METHODS, bench_paper, pair_of_recording, pairs_of_files, read_pair
from densify.learning.network import Model, build, write_model
from densify.readers.street import Street
from tests.command import exit_code, refused
from tests.exported import refusal
from tests.writers import write_street

STEP = np.array([0.3, 0.1, 0.0])


def kitti_file(path: Path, **changes: np.ndarray | None) -> Path:
    """Some boxes full of points that all move by one step."""
    rng = np.random.default_rng(0)
    centres = rng.uniform(-15, 15, (6, 3)) * [1, 1, 0.05]
    points = centres[rng.integers(6, size=600)] + rng.uniform(-1, 1, (600, 3))
    arrays = {"pos1": points, "pos2": points + STEP, "gt": np.tile(STEP, (600, 1)), **changes}
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def test_scores_are_the_papers_and_methods_find_a_common_motion(tmp_path: Path) -> None:
    """Of doing nothing: 0.316 m off, everywhere, at a right angle."""
    kitti_file(tmp_path / "a.npz")
    names = [n for n in METHODS if n not in ("paper-adam", "ours")]
    scores = bench_paper(pairs_of_files(tmp_path, 0), names)
    assert list(scores["methods"]) == names and scores["num_pairs"] == 1
    row = scores["methods"].pop("rest")
    assert row["epe_m"] == pytest.approx(np.linalg.norm(STEP))
    assert row["within_5"] == row["within_10"] == 0
    assert row["angle_rad"] == pytest.approx(np.pi / 2) and "moving_m" not in row
    assert all(row["epe_m"] < 0.15 for row in scores["methods"].values())


def test_flyingthings_comes_in_camera_axes(tmp_path: Path) -> None:
    """Right, down, forward; invalid points and those beyond 35 m ahead do not count."""
    points = np.array([[1.0, 2, 3], [0, 0, 40], [4, 5, 6]])
    path = tmp_path / "a.npz"
    np.savez(
        path, points1=points, points2=points, flow=points / 10, valid_mask1=np.array([1, 1, 0])
    )
    pair = read_pair(path)
    np.testing.assert_allclose(pair.source, [[3, -1, -2]])
    np.testing.assert_allclose(pair.flow, [[0.3, -0.1, -0.2]])
    assert len(pair.target) == 2


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"gt": None}, "holds pos1, pos2, expected points1, points2 and flow, or pos1"),
        ({"gt": np.zeros((5, 3))}, "gt: got 5 rows, expected 600"),
        ({"pos2": np.zeros((5, 2))}, "pos2: got shape (5, 2), expected (N,3) numbers"),
        ({"pos1": np.full((600, 3), np.nan)}, "pos1: got shape"),
        ({"pos1": np.full((600, 3), 99.0)}, "no valid point within 35 m ahead"),
    ],
    ids=str,
)
def test_another_npz_is_refused(tmp_path: Path, changes, words: str) -> None:
    with refusal(words):
        read_pair(kitti_file(tmp_path / "a.npz", **changes))


def test_the_command_measures_and_names_what_is_published(tmp_path: Path, capsys) -> None:
    folder, model = tmp_path / "set", tmp_path / "m.pt"
    folder.mkdir()
    kitti_file(folder / "a.npz")
    write_model(model, Model(build(), {"teacher": "truth", "steps": 0}))
    command = ["bench", "paper", "--kitti", folder, "--methods", "rest"]
    assert exit_code(*command, "--model", model, "--points", "100") == 0
    text = capsys.readouterr().out
    assert "1 pairs, 100 points drawn" in text and "m.pt" in text
    rows = {line.split()[0]: line.split()[-1] for line in text.splitlines() if line}
    assert (rows["epe_m"], rows["within_5"], rows["angle_rad"]) == ("0.093", "0.648", "0.137")


def test_without_truth_networks_are_held_against_the_engine(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow.feather")
    street = Street("street", 5, "vlp16", cameras=())
    log = write_street("argoverse2", street, tmp_path / "log", range(58, 61))
    bare = shutil.copytree(log, tmp_path / "bare", ignore=shutil.ignore_patterns("truth"))
    assert paper.has_truth(str(log)) and not paper.has_truth(str(bare))
    exact, estimated = (pair_of_recording(str(path), 1) for path in (log, bare))
    assert exact.moving.any() and not exact.flow[~exact.moving].any() and len(exact.sweeps) == 3
    assert exact.source.shape == exact.flow.shape == tuple(exact.sweeps[0].points.shape)
    assert 0.05 < np.linalg.norm(exact.flow[exact.moving], axis=1).mean() < 4
    assert abs(len(exact.source) - len(estimated.source)) < 0.02 * len(exact.source)
    assert estimated.flow.shape == estimated.source.shape
    assert not estimated.flow[~estimated.moving].any()


@pytest.mark.parametrize(
    "options, words",
    [
        (["--kitti", "nowhere"], "nowhere: no .npz files"),
        (["--methods", "magic"], "--methods magic: expected some of rest, paper"),
        (["--model", "nowhere.pt"], "nowhere.pt: no such file"),
        (["--points", "0"], "--points 0: expected 1 or more"),
    ],
    ids=str,
)
def test_bad_input_is_one_line(capsys, options, words: str) -> None:
    assert words in refused(capsys, 2, "bench", "paper", *options)
