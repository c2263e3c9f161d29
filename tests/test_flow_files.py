# SPDX-License-Identifier: MIT
"""Flow files: what a run writes it reads again, other forms of the same flow, and broken files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry import poses
from densify.geometry.types import FlowField, Result, Stretch, StretchFlow
from densify.outputs.flow_writers import write_flow_npz
from densify.readers.flow_files import check_argument, read_step
from tests.exact_motion import registered
from tests.scenes import by_flow
from tests.small_street import KEY, POSES_GIVEN, one_car

STEP = (100, 101)
PLAIN = POSES_GIVEN | {"project": {"visibility": False}}  # no point has a say in another's depth


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> tuple[Result, Path]:
    """A run with the flow it found, and the folder of its flow files."""
    result = by_flow(one_car(), KEY, 1, config=PLAIN | {"output": {"flow": "npz"}})
    folder = tmp_path_factory.mktemp("flow")
    write_flow_npz(folder, result.flow, "tiny")
    return result, folder


def test_a_run_leaves_a_file_for_every_step_to_the_key(ours):
    result, folder = ours
    assert result.cloud.moving.sum() > 100
    steps = [(KEY - 1, KEY), (KEY, KEY + 1), (KEY + 1, KEY)]
    assert sorted(result.flow.steps) == steps
    names = [f"{frame:06d}_{target:06d}.npz" for frame, target in steps]
    assert sorted(p.name for p in folder.iterdir()) == names
    with np.load(folder / names[0]) as arrays:
        assert arrays["residual_flow"].dtype == arrays["total_flow"].dtype == np.float32
        assert not arrays["residual_flow"][~arrays["moving"]].any()


def test_the_flow_of_a_run_gives_its_depth_again(ours):
    result, folder = ours
    again = by_flow(one_car(), KEY, 1, config=PLAIN | {"flow": {"engine": f"npz:{folder}"}})
    assert np.array_equal(again.cloud.frame, result.cloud.frame)
    assert np.array_equal(again.cloud.moving, result.cloud.moving)
    assert np.abs(again.cloud.points - result.cloud.points).max() < 2e-5
    new, old = again.depth["front"], result.depth["front"]
    same = (new.frame == old.frame) & (new.frame >= 0)
    assert same.sum() > 3000 and (new.frame == old.frame).mean() > 0.98
    np.testing.assert_allclose(new.depth_m[same], old.depth_m[same], atol=2e-5)


@pytest.mark.parametrize("dropped", ["residual_flow", "residual_flow and to_reference", "row"])
def test_other_forms_of_the_same_flow(ours, dropped, tmp_path):
    """Total flow instead of residual flow; a value for every row of the file instead of 'row'."""
    result, folder = ours
    stretch = result.flow.stretch
    for source, target in result.flow.steps:
        name, num_rows = f"{source:06d}_{target:06d}.npz", len(one_car()[source])
        with np.load(folder / name) as loaded:
            arrays = dict(loaded)
        if dropped == "row":
            row = arrays.pop("row")
            for key, array in arrays.items():
                arrays[key] = np.zeros((num_rows, *array.shape[1:]), array.dtype)
                arrays[key][row] = array
        else:
            arrays = {key: a for key, a in arrays.items() if key not in dropped.split(" and ")}
        np.savez(tmp_path / name, **arrays)
        step = (stretch, stretch.frames.index(source), stretch.frames.index(target))
        read, expected = read_step(tmp_path, *step), read_step(folder, *step)
        assert np.array_equal(read.moving, expected.moving)
        moved_m = expected.total[expected.moving]
        np.testing.assert_allclose(read.total[read.moving], moved_m, atol=2e-5)


@pytest.fixture
def stretch() -> Stretch:
    """Two sweeps of ten points; a sweep's rows are 0, 3, 6, …"""
    points = np.random.default_rng(0).uniform(-20, 20, (10, 3))
    return Stretch(tuple(registered(frame, points) for frame in STEP))


def saved(folder: Path, **arrays: np.ndarray) -> Path:
    path = folder / f"{STEP[0]:06d}_{STEP[1]:06d}.npz"
    np.savez(path, **arrays)
    return path


def test_rows_say_which_points_and_the_rest_stands_still(stretch, tmp_path):
    flow = np.arange(9.0).reshape(3, 3) + 1
    saved(tmp_path, residual_flow=flow, row=np.array([27, 4, 3]))  # no point has row 4
    field = read_step(tmp_path, stretch, 0, 1)
    expected = np.zeros((10, 3))
    expected[9], expected[1] = flow[0], flow[2]
    assert np.array_equal(field.displacement, expected)
    assert np.flatnonzero(field.moving).tolist() == [1, 9]
    assert (field.instance == -1).all() and not field.lost.any() and field.to_reference is None


def test_what_moves_less_than_5_cm_without_being_said_to_move_stands_still(stretch, tmp_path):
    row, flow = stretch[STEP[0]].sweep.row, np.zeros((10, 3))
    flow[:4, 0] = 0.049, 0.051, -3.0, -0.01
    stated = {"moving": np.arange(10) % 2}
    for arrays, moving in (({}, [1, 2]), (stated, [1, 3, 5, 7, 9])):
        saved(tmp_path, residual_flow=flow, row=row, **arrays)
        field = read_step(tmp_path, stretch, 0, 1)
        assert np.flatnonzero(field.moving).tolist() == moving
        np.testing.assert_array_equal(field.displacement, flow * field.moving[:, None])


def test_ego_motion_is_taken_out_of_total_flow(stretch, tmp_path):
    """A world point of the source at rest, and one that moves by 2 m."""
    sweep, T = stretch[STEP[0]].sweep, stretch.T_target_source(STEP[1], STEP[0])
    moved = np.zeros((10, 3))
    moved[5] = 0, 2, 0
    total = poses.transform(T, sweep.points + moved) - sweep.points
    assert np.linalg.norm(total, axis=1).min() > 0.1
    saved(tmp_path, total_flow=total, row=sweep.row, object=np.arange(10))
    field = read_step(tmp_path, stretch, 0, 1)
    np.testing.assert_allclose(field.displacement, moved, atol=1e-9)
    assert np.flatnonzero(field.moving).tolist() == [5]
    assert field.instance.tolist() == list(range(10))


def test_total_flow_holds_the_way_to_the_reference_time_once(stretch, tmp_path):
    one = np.ones((10, 3))
    field = FlowField(2 * one, one[:, 0] > 0, np.zeros(10, np.int32), one[:, 0] < 0, 0.25 * one)
    write_flow_npz(tmp_path, StretchFlow(stretch, {STEP: field}), "tiny")
    (path,) = tmp_path.glob("*.npz")
    with np.load(path) as arrays:
        kept = {name: arrays[name] for name in ("total_flow", "to_reference", "row")}
    np.savez(path, **kept)
    read = read_step(tmp_path, stretch, 0, 1)
    np.testing.assert_allclose(read.displacement, field.displacement, atol=1e-5)
    np.testing.assert_allclose(read.total, field.total, atol=1e-5)


FLOW = np.zeros((30, 3))
BAD_ARRAYS = {
    "no flow": ({"flow": FLOW}, "holds none of the arrays .*total_flow"),
    "narrow": ({"residual_flow": FLOW[:, :2]}, r"residual_flow: got shape \(30, 2\).* \(30, 3\)"),
    "NaN": ({"residual_flow": FLOW * np.nan}, "residual_flow: got NaN or infinite"),
    "negative row": ({"residual_flow": FLOW, "row": np.arange(30) - 1}, "row: got a negative one"),
    "too few": ({"residual_flow": FLOW[:20]}, "holds 20 points, expected .*more than 27.*'row'"),
}


@pytest.mark.parametrize(("arrays", "message"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_flow_files_of_another_form(arrays, message, stretch, tmp_path):
    path = saved(tmp_path, **arrays)
    with pytest.raises(InputError, match=message) as caught:
        read_step(tmp_path, stretch, 0, 1)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_folder_and_file(stretch, tmp_path):
    with pytest.raises(InputError, match=r"npz:.*absent: no such folder"):
        check_argument(str(tmp_path / "absent"))
    with pytest.raises(InputError, match=r"000101_000100\.npz: no such flow file"):
        read_step(tmp_path, stretch, 1, 0)
