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
from densify.readers.flow_files import MOVES_M, check_argument, read_step
from tests.exact_motion import registered
from tests.scenes import by_flow
from tests.small_street import KEY, POSES_GIVEN, one_car

STEP = (100, 101)
PLAIN = POSES_GIVEN | {"project": {"visibility": False}}  # no point has a say in another's depth


# --- from the pipeline and back -------------------------------------------------------------------


@pytest.fixture(scope="module")
def ours(tmp_path_factory) -> tuple[Result, Path]:
    """A run with the flow it found, and the folder of its flow files."""
    result = by_flow(one_car(), KEY, 1, config=PLAIN | {"output": {"flow": "npz"}})
    folder = tmp_path_factory.mktemp("flow")
    write_flow_npz(folder, result.flow, "tiny")
    return result, folder


def depth_from(folder: Path) -> Result:
    return by_flow(one_car(), KEY, 1, config=PLAIN | {"flow": {"engine": f"npz:{folder}"}})


def assert_same(found: Result, ours: Result, of_key: bool = True) -> None:
    """of_key: with the key's own returns, whose way to the reference time a file may not tell."""
    asked = (ours.cloud.frame != KEY) | of_key
    assert np.array_equal(found.cloud.frame, ours.cloud.frame)
    assert np.array_equal(found.cloud.moving, ours.cloud.moving)
    assert np.abs(found.cloud.points - ours.cloud.points)[asked].max() < 2e-5
    here, there = found.depth["front"], ours.depth["front"]
    same = (here.frame == there.frame) & (here.frame >= 0) & ((here.frame != KEY) | of_key)
    assert same.sum() > 3000
    np.testing.assert_allclose(here.depth_m[same], there.depth_m[same], atol=2e-5)
    assert (here.frame == there.frame).mean() > 0.98


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
    assert_same(depth_from(folder), result)


@pytest.mark.parametrize("dropped", ["residual_flow", "residual_flow and to_reference", "row"])
def test_other_forms_of_the_same_flow(ours, dropped, tmp_path):
    """Total flow instead of residual flow; a value for every row of the file instead of 'row'."""
    result, folder = ours
    num_rows = {f: len(one_car()[f]) for f in (KEY - 1, KEY, KEY + 1)}
    for path in folder.iterdir():
        with np.load(path) as loaded:
            arrays = dict(loaded)
        if dropped == "row":
            row = arrays.pop("row")
            for name, array in arrays.items():
                whole = np.zeros((num_rows[int(path.stem[:6])], *array.shape[1:]), array.dtype)
                whole[row] = array
                arrays[name] = whole
        else:
            arrays = {name: a for name, a in arrays.items() if name not in dropped.split(" and ")}
        np.savez(tmp_path / path.name, **arrays)
    assert_same(depth_from(tmp_path), result, of_key="to_reference" not in dropped)


# --- one file -------------------------------------------------------------------------------------


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
    row = stretch[STEP[0]].sweep.row
    flow = np.zeros((10, 3))
    flow[:4, 0] = 0.049, 0.051, -3.0, -0.01
    saved(tmp_path, residual_flow=flow, row=row)
    field = read_step(tmp_path, stretch, 0, 1)
    assert MOVES_M == 0.05 and np.flatnonzero(field.moving).tolist() == [1, 2]
    assert not field.displacement[~field.moving].any()
    said = np.arange(10) % 2 == 1
    saved(tmp_path, residual_flow=flow, row=row, moving=said.astype(np.uint8))
    field = read_step(tmp_path, stretch, 0, 1)
    assert np.array_equal(field.moving, said)
    assert np.array_equal(field.displacement, np.where(said[:, None], flow, 0))


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
    sweep = stretch[STEP[0]].sweep
    one = np.ones((10, 3))
    field = FlowField(2 * one, one[:, 0] > 0, np.zeros(10, np.int32), one[:, 0] < 0, 0.25 * one)
    write_flow_npz(tmp_path, StretchFlow(stretch, {STEP: field}), "tiny")
    path = tmp_path / f"{STEP[0]:06d}_{STEP[1]:06d}.npz"
    with np.load(path) as arrays:
        known = {name: arrays[name] for name in ("total_flow", "to_reference", "row")}
    saved(tmp_path, **known)
    found = read_step(tmp_path, stretch, 0, 1)
    np.testing.assert_allclose(found.displacement, field.displacement, atol=1e-5)
    np.testing.assert_allclose(found.total, field.total, atol=1e-5)
    assert len(sweep) == 10


FLOW = np.zeros((30, 3))
BAD_ARRAYS = {
    "no flow": ({"flow": FLOW}, "holds none of the arrays .*total_flow"),
    "narrow": ({"residual_flow": FLOW[:, :2]}, r"residual_flow: got shape \(30, 2\).* \(30, 3\)"),
    "NaN": ({"residual_flow": FLOW * np.nan}, "residual_flow: got NaN or infinite"),
    "negative row": ({"residual_flow": FLOW, "row": np.arange(30) - 1}, "row: got a negative one"),
    "too few": ({"residual_flow": FLOW[:20]}, "holds 20 points, expected .*more than 27.*'row'"),
}


@pytest.mark.parametrize("case", BAD_ARRAYS)
def test_flow_files_of_another_form(case, stretch, tmp_path):
    arrays, message = BAD_ARRAYS[case]
    path = saved(tmp_path, **arrays)
    with pytest.raises(InputError, match=message) as caught:
        read_step(tmp_path, stretch, 0, 1)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_missing_folder_and_file(stretch, tmp_path):
    with pytest.raises(InputError, match=r"npz:.*absent: no such folder"):
        check_argument(str(tmp_path / "absent"))
    with pytest.raises(InputError, match=r"000101_000100\.npz: no such flow file"):
        read_step(tmp_path, stretch, 1, 0)
