# SPDX-License-Identifier: MIT
"""The paper's tables: scores by hand, sets of others as files, and the command."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from densify.bench.paper import METHODS, bench_paper, rigid_icp
from densify.bench.paper_pairs import (
    GROUND_M,
    PaperPair,
    has_truth,
    pair_of_recording,
    pairs_of_boxes,
    pairs_of_files,
    pairs_of_kitti,
    read_moments,
    read_pair,
)
from densify.cli import main
from densify.config.errors import InputError
from densify.learning.model_file import Model, write_model
from densify.learning.network import build
from densify.readers.street import Street
from tests.writers import write_street

STEP = np.array([0.3, 0.1, 0.0])


def blocks(seed: int = 0, num_points: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Some boxes full of points, and which of them the points belong to."""
    rng = np.random.default_rng(seed)
    own = rng.integers(6, size=num_points)
    centres = rng.uniform(-15, 15, (6, 3)) * [1, 1, 0.05]
    return centres[own] + rng.uniform(-1, 1, (num_points, 3)), own


def kitti_file(path: Path, **changes: np.ndarray) -> Path:
    points, _ = blocks()
    arrays = {"pos1": points, "pos2": points + STEP, "gt": np.tile(STEP, (len(points), 1))}
    np.savez(path, **{n: a for n, a in {**arrays, **changes}.items() if a is not None})
    return path


def test_scores_are_the_papers(tmp_path: Path) -> None:
    """Of doing nothing: 0.316 m off, everywhere, at a right angle."""
    found = bench_paper(pairs_of_files(kitti_file(tmp_path / "a.npz").parent, 0), ["rest"])
    row = found["methods"]["rest"]
    assert row["epe_m"] == pytest.approx(np.linalg.norm(STEP))
    assert row["within_5"] == row["within_10"] == 0
    assert row["angle_rad"] == pytest.approx(np.pi / 2)
    assert found["num_pairs"] == 1 and "moving_m" not in row


def test_methods_find_a_motion_that_all_share(tmp_path: Path) -> None:
    kitti_file(tmp_path / "a.npz")
    names = [n for n in METHODS if n not in ("paper-adam", "rest", "ours")]
    rows = bench_paper(pairs_of_files(tmp_path, 0), names)["methods"]
    assert rows["icp"]["epe_m"] < 0.01 and rows["icp"]["within_5"] == 1
    assert all(row["epe_m"] < 0.15 for row in rows.values())
    assert list(rows) == [n for n in METHODS if n in names]


def test_rigid_icp_finds_a_turn() -> None:
    points, _ = blocks(3)
    c, s = np.cos(0.02), np.sin(0.02)
    moved = points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + STEP
    np.testing.assert_allclose(points + rigid_icp(points, moved), moved, atol=1e-3)


def test_curves_have_all_their_points(tmp_path: Path) -> None:
    kitti_file(tmp_path / "a.npz")
    found = bench_paper(pairs_of_files(tmp_path, 0), ["rest"], curves=True)
    assert list(found["neighbors"]) == ["5", "10", "20", "50", "100"]
    assert list(found["points"]) == ["512", "1024", "2048", "4096", "8192"]
    assert all(row["epe_m"] < 0.3 for row in found["neighbors"].values())


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
    "changes, told",
    [
        ({"gt": None}, r"holds pos1, pos2, expected points1, points2 and flow, or pos1"),
        ({"gt": np.zeros((5, 3))}, "gt: got 5 rows, expected 600"),
        ({"pos2": np.zeros((5, 2))}, r"pos2: got shape \(5, 2\), expected \(N,3\) numbers"),
        ({"pos1": np.full((600, 3), np.nan)}, "pos1: got shape"),
        ({"pos1": np.full((600, 3), 99.0)}, "no valid point within 35 m ahead"),
    ],
    ids=str,
)
def test_another_npz_is_refused(tmp_path: Path, changes, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_pair(kitti_file(tmp_path / "a.npz", **changes))


FOCAL_PX, BASELINE_M, CENTRE_PX = 720.0, 0.54, np.array([100.0, 30.0])
OWN_M, WALL_M = np.array([0.1, 0.0, -1.0]), np.array([0.4, 0.0, 0.5])


def scene_flow_folder(root: Path) -> Path:
    """KITTI's scene flow 2015: a wall 12 m ahead that moves, another 50 m ahead, the road."""
    v, u = np.mgrid[:100, :200]
    rays = np.dstack(
        [(u - CENTRE_PX[0]) / FOCAL_PX, (v - CENTRE_PX[1]) / FOCAL_PX, np.ones(u.shape)]
    )
    wall = (abs(u - 90) < 40) & (v < 90)
    depth_m = np.where(wall, 12.0, np.minimum(1.65 / np.maximum(rays[..., 1], 1e-6), 50.0))
    here = rays * depth_m[..., None]
    there = here + np.where(wall[..., None], WALL_M, OWN_M)
    moved_px = there[..., :2] / there[..., 2:] * FOCAL_PX + CENTRE_PX - np.stack([u, v], axis=-1)
    valid = np.ones(u.shape)
    valid[40:50, 80:90] = 0
    images = {
        "disp_occ_0": 256 * FOCAL_PX * BASELINE_M / here[..., 2],
        "disp_occ_1": 256 * FOCAL_PX * BASELINE_M / there[..., 2],
        "flow_occ": np.dstack(
            [valid, 64 * moved_px[..., 1] + 2**15, 64 * moved_px[..., 0] + 2**15]
        ),
    }
    images["disp_occ_0"][:, 99] = 0  # as where no disparity is known
    for name, image in images.items():
        (root / "training" / name).mkdir(parents=True)
        cv2.imwrite(
            str(root / "training" / name / "000003_10.png"), np.rint(image).astype(np.uint16)
        )
    left, right = (
        f"{FOCAL_PX} 0 {CENTRE_PX[0]} {FOCAL_PX * x} 0 {FOCAL_PX} {CENTRE_PX[1]} 0 0 0 1 0"
        for x in (0.06, 0.06 - BASELINE_M)
    )
    (root / "training" / "calib_cam_to_cam").mkdir()
    calibration = root / "training" / "calib_cam_to_cam" / "000003.txt"
    calibration.write_text(f"P_rect_02: {left}\nP_rect_03: {right}\n")
    return root


@pytest.mark.parametrize("within", ["", "training"])
def test_kittis_disparities_and_flow_are_lifted(tmp_path: Path, within: str) -> None:
    """The wall alone is left of what is nearer than 35 m and no road, at its own depth, and goes
    as far as it does."""
    pairs = list(pairs_of_kitti(scene_flow_folder(tmp_path) / within, 0))
    assert [pair.name for pair in pairs] == ["000003_10"]
    pair = pairs[0]
    on_wall = 79 * 90 - 90 - 100  # without the column and the square where something is unknown
    assert len(pair.source) + len(pair.target) == on_wall
    assert abs(len(pair.source) - len(pair.target)) < 100
    np.testing.assert_allclose(pair.source[:, 0], 12.0, atol=0.01)
    assert pair.source[:, 2].max() < 12 * 31 / FOCAL_PX and pair.source[:, 2].min() > -1.0
    ahead_left_up = [WALL_M[2], -WALL_M[0], -WALL_M[1]]
    np.testing.assert_allclose(pair.flow, np.tile(ahead_left_up, (len(pair.flow), 1)), atol=0.01)
    arrived = pair.source + pair.flow
    apart_m = np.linalg.norm(arrived[:200, None] - pair.target[None], axis=2).min(axis=1)
    assert 0.01 < np.median(apart_m) < 0.03  # a pixel aside


def test_the_road_is_left_out_where_it_stays_the_road(tmp_path: Path) -> None:
    training = scene_flow_folder(tmp_path) / "training"
    here, there, _ = read_moments(training, "000003_10")
    low = (np.minimum(here[:, 1], there[:, 1]) > GROUND_M) & (here[:, 2] < 45)
    np.testing.assert_allclose(here[low, 1], 1.65, atol=0.01)
    assert low.sum() > 500
    np.testing.assert_allclose((there - here)[low].mean(axis=0), OWN_M, atol=0.01)


@pytest.mark.parametrize(
    "name, image, told",
    [
        ("disp_occ_0", np.ones((100, 200), np.uint8), "got uint8 of shape"),
        ("flow_occ", np.ones((100, 200), np.uint16), "got uint16 of shape"),
        ("disp_occ_1", np.ones((9, 8), np.uint16), "differ in size"),
        ("disp_occ_0", np.zeros((100, 200), np.uint16), "no valid point within 35 m ahead"),
        ("flow_occ", None, "000003_10.png: cannot be read"),
        ("disp_occ_0", None, r"disp_occ_0: no images such as 000000_10.png"),
    ],
    ids=str,
)
def test_another_scene_flow_folder_is_refused(tmp_path: Path, name: str, image, told: str) -> None:
    path = scene_flow_folder(tmp_path) / "training" / name / "000003_10.png"
    path.unlink()
    if image is not None:
        cv2.imwrite(str(path), image)
    with pytest.raises(InputError, match=told):
        list(pairs_of_kitti(tmp_path, 0))


def test_cameras_the_wrong_way_round_are_refused(tmp_path: Path) -> None:
    path = scene_flow_folder(tmp_path) / "training" / "calib_cam_to_cam" / "000003.txt"
    text = path.read_text()
    path.write_text(text.replace("_02", "_xx").replace("_03", "_02").replace("_xx", "_03"))
    with pytest.raises(InputError, match="P_rect_03 is not to the right"):
        list(pairs_of_kitti(tmp_path, 0))


def test_a_street_is_a_set() -> None:
    pair = pair_of_recording("street?seed=31&sensor=vlp16", 80)
    assert isinstance(pair, PaperPair) and pair.moving is not None and pair.moving.any()
    assert not pair.flow[~pair.moving].any() and len(pair.sweeps) == 5
    assert pair.source.shape == pair.flow.shape == tuple(pair.sweeps[0].points.shape)
    gap_m = np.linalg.norm(pair.flow[pair.moving], axis=1)
    assert gap_m.max() < 4 and gap_m.mean() > 0.05


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    pytest.importorskip("pyarrow.feather")
    street = Street("street", 5, "vlp16", cameras=())
    return write_street("argoverse2", street, tmp_path_factory.mktemp("log"), range(58, 61))


def test_boxes_make_the_flow_that_the_sensor_sees(log: Path) -> None:
    """What stands moves as the vehicle makes it; what is in a moving box meets itself again."""
    pairs = list(pairs_of_boxes([f"argoverse2:{log}"], 0))
    assert len(pairs) == 2
    pair = pairs[0]
    assert pair.moving is not None and pair.moving.sum() > 50
    np.testing.assert_allclose(pair.flow[~pair.moving], pair.of_vehicle()[~pair.moving], atol=1e-9)
    assert np.linalg.norm(pair.of_vehicle(), axis=1).mean() > 0.1
    reached_m, _ = cKDTree(pair.target).query((pair.source + pair.flow)[pair.moving])
    before_m, _ = cKDTree(pair.target).query(pair.source[pair.moving])
    assert np.median(reached_m) < 0.1 and reached_m.mean() < 0.5 * before_m.mean()
    rows = bench_paper(pairs[:1], ["rest"])["methods"]["rest"]
    assert rows["static_m"] < 1e-6 and rows["moving_m"] > 0.2


def test_ours_sees_clouds_without_the_vehicles_motion(log: Path) -> None:
    row = bench_paper(pairs_of_boxes([f"argoverse2:{log}"], 1), ["ours"])["methods"]["ours"]
    assert row["static_m"] < 0.01


def test_the_command_labels_recordings(log: Path, capsys) -> None:
    command = ["bench", "paper", "--argoverse", str(log), "--methods", "rest", "--pairs", "1"]
    assert main(command) == 0
    told = capsys.readouterr().out
    assert "argoverse: 1 pairs, 2048 points drawn" in told
    (error,) = [line for line in told.splitlines() if line.startswith("epe_m")]
    assert "as published" in told and error.split()[-1] == "0.257"


def test_the_command_measures_and_names_what_is_published(tmp_path: Path, capsys) -> None:
    folder, out, model = tmp_path / "set", tmp_path / "t.json", tmp_path / "m.pt"
    folder.mkdir()
    kitti_file(folder / "a.npz")
    write_model(model, Model(build(), {"teacher": "truth", "steps": 0}))
    command = ["bench", "paper", "--kitti", str(folder), "--methods", "rest", "--out", str(out)]
    assert main([*command, "--model", str(model), "--points", "100"]) == 0
    told = capsys.readouterr().out
    assert "1 pairs, 100 points drawn" in told and "m.pt" in told
    rows = {line.split()[0]: line.split()[-1] for line in told.splitlines() if line}
    assert (rows["epe_m"], rows["within_5"], rows["angle_rad"]) == ("0.093", "0.648", "0.137")
    assert json.loads(out.read_text())["sets"]["kitti"]["methods"]["rest"]["epe_m"] > 0.3


def test_without_truth_networks_are_held_against_the_engine(log: Path, tmp_path: Path) -> None:
    bare = shutil.copytree(log, tmp_path / "log", ignore=shutil.ignore_patterns("truth"))
    assert has_truth(str(log)) and not has_truth(str(bare))
    exact, found = (pair_of_recording(str(place), 1) for place in (log, bare))
    assert abs(len(exact.source) - len(found.source)) < 0.02 * len(exact.source)
    assert found.flow.shape == found.source.shape and not found.flow[~found.moving].any()


@pytest.mark.parametrize(
    "options, told",
    [
        (["--kitti", "nowhere"], "nowhere: no .npz files"),
        (["--methods", "magic"], "--methods magic: expected some of rest, icp"),
        (["--model", "nowhere.pt"], "nowhere.pt: no such file"),
        (["--points", "0"], "--points 0: expected 1 or more"),
        (["--nuscenes", "nowhere"], "nowhere: no nuScenes tables"),
    ],
    ids=str,
)
def test_bad_input_is_one_line(capsys, options, told: str) -> None:
    assert main(["bench", "paper", *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and told in lines[0]
