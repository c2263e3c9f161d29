# SPDX-License-Identifier: MIT
"""Scene flow from boxes: by hand, and on a street that writes its boxes against its exact flow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from densify.cli import main
from densify.errors import InputError
from densify.flow.boxes import BoxMargins, flow_of_boxes
from densify.readers import open_sequence
from densify.readers.street import Street
from densify.types import Boxes
from densify.writers import write_street

pytest.importorskip("pyarrow.feather")
FRAMES = range(58, 63)


def boxes(*placed: tuple[int, float, float, float]) -> Boxes:
    """track, x, y, yaw; 4 x 2 x 1.5 m."""
    T = []
    for _, x, y, yaw in placed:
        c, s = np.cos(yaw), np.sin(yaw)
        T.append([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1]])
    return Boxes(
        np.array([p[0] for p in placed], np.int64),
        np.reshape(np.array(T, float), (-1, 4, 4)),
        np.tile([4.0, 2.0, 1.5], (len(placed), 1)),
    )


def test_points_in_a_box_turn_with_it() -> None:
    points = np.array([[11.0, 0, 0], [9, 0.5, 0], [20, 0, 0]])
    field, sure = flow_of_boxes(
        points, boxes((7, 10, 0, 0)), boxes((7, 11, 0, np.pi / 2)), np.eye(4), 0.1
    )
    np.testing.assert_allclose(field.displacement, [[0, 1, 0], [1.5, -1.5, 0], [0, 0, 0]])
    assert field.moving.tolist() == [True, True, False] and sure.all()
    assert field.instance.tolist() == [0, 0, -1]


def test_the_vehicles_own_motion_is_taken_out() -> None:
    """The vehicle drives 2 m ahead; a parked car is 2 m nearer afterwards, and stands."""
    T_here_next = np.eye(4)
    T_here_next[0, 3] = 2.0
    points = np.array([[10.0, 0, 0]])
    field, _ = flow_of_boxes(points, boxes((1, 10, 0, 0)), boxes((1, 8, 0, 0)), T_here_next, 0.1)
    assert not field.moving.any() and not field.displacement.any()
    field, _ = flow_of_boxes(points, boxes((1, 10, 0, 0)), boxes((1, 9, 0, 0)), T_here_next, 0.1)
    np.testing.assert_allclose(field.displacement, [[1, 0, 0]])


def test_what_is_unsure_does_not_count() -> None:
    """In two boxes, just outside one, in one that vanishes."""
    here = boxes((1, 0, 0, 0), (2, 3, 0, 0), (3, 30, 0, 0))
    there = boxes((1, 1, 0, 0), (2, 3, 0, 0))
    points = np.array([[1.5, 0, 0], [-2.25, 0, 0], [-2.05, 0, 0], [30, 0, 0], [-9, 0, 0]])
    field, sure = flow_of_boxes(points, here, there, np.eye(4), 0.1, BoxMargins(0.1, 0.3))
    assert sure.tolist() == [False, False, True, False, True]
    assert field.moving.tolist() == [False, False, True, False, False]


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    street = Street("crossing", 5, "vlp16", cameras=())
    return write_street("argoverse2", street, tmp_path_factory.mktemp("log"), FRAMES)


def test_labels_of_a_street_are_its_exact_flow(log: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "labels"
    assert main(["labels", "--data", str(log), "--out", str(out)]) == 0
    assert "4 sweeps" in capsys.readouterr().out
    assert [p.name for p in sorted(out.iterdir())] == [f"{i:06d}_{i + 1:06d}.npz" for i in range(4)]
    sequence = open_sequence(str(log))
    errors_m, still_m, missed, unsure, moving_m = [], [], [], [], []
    for i in range(4):
        with np.load(out / f"{i:06d}_{i + 1:06d}.npz") as file:
            found = dict(file)
        true = sequence.truth.displacement(i, i + 1)[found["row"]]
        moves = np.linalg.norm(true, axis=1) > 0.1
        valid = found["valid"]
        error_m = np.linalg.norm(found["residual_flow"] - true, axis=1)
        errors_m.append(error_m[moves & valid])
        moving_m.append(np.linalg.norm(true, axis=1)[moves & valid])
        still_m.append(error_m[~moves & valid])
        missed.append(~found["moving"][moves & valid])
        unsure.append(~valid)
    moved = np.concatenate(errors_m)
    assert len(moved) > 100 and np.concatenate(moving_m).mean() > 0.3
    assert np.median(moved) < 0.05
    assert np.concatenate(missed).mean() < 0.1
    assert (np.concatenate(still_m) > 0.05).mean() < 0.01
    assert np.concatenate(unsure).mean() < 0.05


def test_ground_is_left_out_on_request(log: Path, tmp_path: Path) -> None:
    command = ["labels", "--data", str(log), "--keys", "1:2", "--out"]
    assert main([*command, str(tmp_path / "all")]) == 0
    assert main([*command, str(tmp_path / "above"), "--without-ground"]) == 0
    masks = []
    for name in ("all", "above"):
        with np.load(tmp_path / name / "000001_000002.npz") as file:
            masks.append(file["valid"])
    assert (masks[1] <= masks[0]).all() and masks[1].sum() < 0.9 * masks[0].sum()


def test_labels_are_kept(log: Path, tmp_path: Path, capsys) -> None:
    command = ["labels", "--data", str(log), "--keys", "1:2", "--out", str(tmp_path)]
    assert main(command) == 0
    assert main(command) == 2
    assert "there already, kept; give --overwrite" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0


def test_a_recording_without_boxes_is_refused(tmp_path: Path, capsys) -> None:
    assert main(["labels", "--data", "street", "--out", str(tmp_path / "x")]) == 2
    assert "no tracked boxes; expected an Argoverse 2 log" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_damaged_boxes_are_refused(log: Path, tmp_path: Path) -> None:
    import shutil

    import pyarrow as arrow
    from pyarrow import feather

    copy = shutil.copytree(log, tmp_path / "log")
    table = feather.read_table(copy / "annotations.feather")
    assert open_sequence(str(copy)).boxes(0).size_m.min() > 0.2
    flat = table.set_column(
        table.column_names.index("width_m"), "width_m", arrow.array(np.zeros(len(table)))
    )
    feather.write_feather(flat, str(copy / "annotations.feather"))
    with pytest.raises(InputError, match="a box of sweep 0 has no size"):
        open_sequence(str(copy)).boxes(0)
    feather.write_feather(table.drop_columns(["qw"]), str(copy / "annotations.feather"))
    with pytest.raises(InputError, match="no column qw"):
        open_sequence(str(copy)).boxes(0)
    (copy / "annotations.feather").unlink()
    assert open_sequence(str(copy)).boxes(0) is None
