# SPDX-License-Identifier: MIT
"""The TruckScenes reader on a small tree of two lidars written here as its documentation says."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry.poses import transform
from densify.readers import open_sequence
from densify.readers.nuscenes import TruckScenes

START_US = 1_695_473_372_700_000
SPEED_M_S = 20.0
LATE_US = {"LIDAR_LEFT": 0, "LIDAR_RIGHT": 7_000}
T_EGO_LIDAR = {}
for _name, _side in (("LIDAR_LEFT", 1.3), ("LIDAR_RIGHT", -1.3)):
    T_EGO_LIDAR[_name] = np.eye(4)
    T_EGO_LIDAR[_name][:3, :3] = Rotation.from_euler("z", 30 * _side, degrees=True).as_matrix()
    T_EGO_LIDAR[_name][:3, 3] = [5.0, _side, 2.0]


def w_x_y_z(T):
    return Rotation.from_matrix(T[:3, :3]).as_quat()[[3, 0, 1, 2]].tolist()


def write_pcd(path, columns):
    """Binary, of the fields that the data set has."""
    kinds = {"x": "<f4", "y": "<f4", "z": "<f4", "intensity": "<f4", "timestamp": "<u8"}
    kinds = {name: kind for name, kind in kinds.items() if name in columns}
    rows = np.zeros(len(columns["x"]), list(kinds.items()))
    for name in kinds:
        rows[name] = columns[name]
    header = (
        "# .PCD v0.7\nVERSION 0.7\n"
        f"FIELDS {' '.join(kinds)}\n"
        f"SIZE {' '.join(kind[2] for kind in kinds.values())}\n"
        f"TYPE {' '.join(kind[1].upper() for kind in kinds.values())}\n"
        f"COUNT {' '.join('1' for _ in kinds)}\n"
        f"WIDTH {len(rows)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header.encode() + rows.tobytes())


def points_of(channel, number):
    rng = np.random.default_rng([number, len(channel)])
    columns = dict(zip("xyz", rng.uniform(-30, 30, (3, 50)).astype(np.float32), strict=True))
    columns["intensity"] = rng.integers(0, 255, 50)
    columns["timestamp"] = START_US + number * 100_000 + LATE_US[channel] + np.arange(50) * 1_000
    for axis in "xyz":
        columns[axis][3] = np.nan
    return columns


@pytest.fixture
def root(tmp_path):
    """Three sweeps of two lidars; the second one's last is missing from the table."""
    tables = {name: [] for name in ("sample_data", "ego_pose", "calibrated_sensor", "sensor")}
    for channel, T in T_EGO_LIDAR.items():
        tables["sensor"].append({"token": channel, "channel": channel, "modality": "lidar"})
        place = {"translation": T[:3, 3].tolist(), "rotation": w_x_y_z(T)}
        tables["calibrated_sensor"].append(
            {"token": f"c{channel}", "sensor_token": channel, **place, "camera_intrinsic": []}
        )
        for number in range(3 if channel == "LIDAR_LEFT" else 2):
            stamp_us = START_US + number * 100_000 + LATE_US[channel]
            token, file = f"{channel}{number}", f"samples/{channel}/{channel}_{stamp_us}.pcd"
            ahead_m = SPEED_M_S * (stamp_us - START_US) * 1e-6
            tables["ego_pose"].append(
                {
                    "token": token,
                    "timestamp": stamp_us,
                    "translation": [600_000 + ahead_m, 5_300_000.0, 0.0],
                    "rotation": [1, 0, 0, 0],
                }
            )
            tables["sample_data"].append(
                {
                    "token": token,
                    "sample_token": "s",
                    "ego_pose_token": token,
                    "calibrated_sensor_token": f"c{channel}",
                    "filename": file,
                    "timestamp": stamp_us,
                }
            )
            write_pcd(tmp_path / file, points_of(channel, number))
    tables["sample"] = [{"token": "s", "scene_token": "scene", "timestamp": START_US}]
    tables["scene"] = [{"token": "scene", "name": "scene-0044384a"}]
    for name, records in tables.items():
        (tmp_path / "v1.0-mini").mkdir(exist_ok=True)
        (tmp_path / "v1.0-mini" / f"{name}.json").write_text(json.dumps(records))
    return tmp_path


def test_lidars_are_one_sweep_in_the_vehicles_frame(root):
    sequence = open_sequence(root)
    assert isinstance(sequence, TruckScenes) and list(sequence.frames) == [0, 1, 2]
    for number in range(2):
        sweep = sequence[number]
        assert sweep.stamp_ns == (START_US + number * 100_000) * 1000
        np.testing.assert_allclose(sweep.scanner_origins, [[5, 1.3, 2], [5, -1.3, 2]])
        for axes, T in zip(sweep.R_scanner_lidar, T_EGO_LIDAR.values(), strict=True):
            np.testing.assert_allclose(axes @ T[:3, :3], np.eye(3), atol=1e-9)
        for index, (channel, T) in enumerate(T_EGO_LIDAR.items()):
            mine = sweep.select(sweep.lidar == index)
            columns = points_of(channel, number)
            fired = np.stack([columns[axis] for axis in "xyz"], axis=1).astype(float)
            valid = np.isfinite(fired).all(axis=1)
            np.testing.assert_allclose(mine.points, transform(T, fired[valid]), atol=1e-9)
            late_us = LATE_US[channel] + np.arange(50)[valid] * 1_000
            np.testing.assert_array_equal(mine.offset_ns, late_us * 1000)
            np.testing.assert_allclose(mine.intensity, columns["intensity"][valid] / 255, atol=1e-6)
    step = np.linalg.inv(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(1)
    np.testing.assert_allclose(step[:3, 3], [SPEED_M_S * 0.1, 0, 0], atol=1e-6)


def test_a_lidar_without_a_sweep_near_is_left_out(root):
    sweep = open_sequence(root)[2]
    assert set(sweep.lidar) == {0} and len(sweep) == 49


def test_boxes_are_in_the_vehicles_frame_between_key_frames(root):
    """One that stands in the world, 30 m before where the vehicle is at first; key frames 0.2 s
    apart."""
    tables, box = root / "v1.0-mini", {"rotation": [1, 0, 0, 0], "size": [2.5, 12.0, 4.0]}
    box |= {"instance_token": "truck", "translation": [600_030, 5_300_001, 2]}
    samples = [
        {"token": token, "scene_token": "scene", "timestamp": START_US + late_us}
        for token, late_us in (("s", 0), ("t", 200_000))
    ]
    annotations = [{"token": f"a{s['token']}", "sample_token": s["token"], **box} for s in samples]
    (tables / "sample.json").write_text(json.dumps(samples))
    (tables / "sample_annotation.json").write_text(json.dumps(annotations))
    sequence = open_sequence(root)
    for number in range(3):
        boxes = sequence.boxes(number)
        assert boxes.track.tolist() == ["truck"]
        place_m = [30 - number * SPEED_M_S * 0.1, 1, 2]
        np.testing.assert_allclose(boxes.T_lidar_box[0, :3, 3], place_m, atol=1e-6)
        np.testing.assert_array_equal(boxes.size_m, [[12.0, 2.5, 4.0]])


DAMAGE = {
    "truncated": (
        lambda root: [p.write_bytes(p.read_bytes()[:400]) for p in root.glob("samples/*/*.pcd")],
        "not a readable .pcd",
    ),
    "missing": (
        lambda root: [p.unlink() for p in (root / "samples/LIDAR_RIGHT").iterdir()],
        "(?i)no such file",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_trees_are_refused_in_a_line(root, damage):
    harm, says = DAMAGE[damage]
    harm(root)
    with pytest.raises(InputError, match=says) as error:
        open_sequence(root)[0]
    assert "\n" not in str(error.value) and str(root) in str(error.value)
