# SPDX-License-Identifier: MIT
"""The Waymo reader on a street written as a segment and against the published formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from writers.waymo import POSED_COLUMNS, T_EGO_LIDAR, pixels

from densify.geometry.poses import inverse, transform
from densify.readers import describe, open_sequence
from densify.readers.waymo import Waymo
from tests.reader_checks import check_cameras, check_image_poses, check_truth
from tests.recorded import FRAMES

pyarrow, parquet = (pytest.importorskip(name) for name in ("pyarrow", "pyarrow.parquet"))

FORMAT = "waymo"
LIDAR, POSE = "[LiDARComponent].range_image_return", "[LiDARPoseComponent].range_image_return1"
CALIBRATION = "[LiDARCalibrationComponent]"


def table_of(root, component):
    return parquet.read_table(root / component / "street.parquet")


def rows_of(root, component):
    return table_of(root, component).to_pylist()


def put(root, component, rows):
    table = pyarrow.Table.from_pylist(rows, schema=table_of(root, component).schema)
    parquet.write_table(table, root / component / "street.parquet")


def test_the_street_is_given_back(written, excerpt):
    sequence = open_sequence(written)
    assert isinstance(sequence, Waymo) and list(sequence.frames) == [0, 1, 2]
    for number, frame in enumerate(FRAMES):
        read, true = sequence[number], excerpt.street[frame]
        order = np.argsort(pixels(excerpt, frame))
        assert read.stamp_ns == sequence.stamp_ns(number) == true.stamp_ns
        assert len(read) == len(true) and not read.lidar.any()
        np.testing.assert_allclose(read.scanner_origins[0], [1.43, 0, 2.18])
        away, expected = read.points - read.scanner_origins[0], true.points[order]
        range_m = np.linalg.norm(expected, axis=1)
        np.testing.assert_allclose(np.linalg.norm(away, axis=1), range_m, rtol=1e-6)
        # the middle of a column, 1800 of them
        off_rad = np.linalg.norm(away - expected, axis=1) / range_m
        assert off_rad.max() < 1.01 * np.pi / 1800
        assert np.abs(read.offset_ns - true.offset_ns[order]).max() < 150_000
        np.testing.assert_allclose(
            read.intensity, np.minimum(true.intensity[order], 0.999), atol=1e-5
        )
    check_truth(sequence, replace(excerpt, cameras=()))
    step = inverse(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(2)
    first, last = (
        excerpt.pose(excerpt.street.stamp_ns(f), inverse(T_EGO_LIDAR)) for f in FRAMES[::2]
    )
    np.testing.assert_allclose(step, inverse(first) @ last, atol=1e-9)


def test_cameras_are_given_back(written, excerpt):
    sequence = open_sequence(written)
    names = dict(zip(excerpt.cameras, ("FRONT", "FRONT_LEFT"), strict=True))
    T_lidar_ego = inverse(T_EGO_LIDAR)
    check_cameras(sequence, excerpt, T_lidar_ego, 1000, same_pixels=False, names=names)
    check_image_poses(sequence, excerpt, 2e-3, names)
    for street_name, name in names.items():
        read, true = sequence.cameras[name], excerpt.street.cameras[street_name]
        assert read.is_rectified and read.row_time_s == pytest.approx(true.row_time_s, rel=0.01)
    assert "rolling shutter of 18.8 ms" in describe(sequence)


# The published formulas


def official_points(image, inclinations, extrinsic, pixel_pose=None, frame_pose=None):
    """compute_range_image_polar, _cartesian of waymo_open_dataset/utils/range_image_utils.py, pixel
    by pixel."""
    width, correction = image.shape[1], np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    points = []
    for v, u in np.argwhere(image[..., 0] > 0):
        ratio, rise = (width - u - 0.5) / width, inclinations[::-1][v]
        azimuth = (ratio * 2 - 1) * np.pi - correction
        ray = [np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)]
        point = extrinsic[:3, :3] @ (image[v, u, 0] * np.array(ray)) + extrinsic[:3, 3]
        if pixel_pose is not None:
            roll_pitch_yaw, position = np.split(pixel_pose[v, u], 2)
            world = Rotation.from_euler("xyz", roll_pitch_yaw).apply(point) + position
            point = transform(inverse(frame_pose), world[None])[0]
        points.append(point)
    return np.array(points)


def test_compensated_they_are_the_points_of_the_published_conversion(written):
    sequence = open_sequence(written)
    image, pixel_pose = (
        np.reshape(row[f"{name}.values"], row[f"{name}.shape"])
        for name, row in (
            (f"{LIDAR}1", rows_of(written, "lidar")[1]),
            (POSE, rows_of(written, "lidar_pose")[1]),
        )
    )
    image[:, np.arange(image.shape[1]) % POSED_COLUMNS > 0, 0] = 0
    laser = rows_of(written, "lidar_calibration")[0]
    extrinsic = np.reshape(laser[f"{CALIBRATION}.extrinsic.transform"], (4, 4))
    beams = np.array(laser[f"{CALIBRATION}.beam_inclination.values"])
    expected = official_points(image, beams, extrinsic, pixel_pose, sequence.T_world_lidar(1))
    sweep = sequence[1]
    kept = sweep.select(sweep.row % image.shape[1] % POSED_COLUMNS == 0)
    assert len(kept) == len(expected) > 200
    compensated = sequence._track.compensate(kept.points, kept.stamp_ns, kept.offset_ns)
    np.testing.assert_allclose(compensated, expected, atol=0.01)


def test_five_lidars_and_both_returns(broken):
    """A small side lidar with even beams, turned, that hits something twice."""
    rng, rows = np.random.default_rng(0), rows_of(broken, "lidar")
    side = {1: rng.uniform(3, 20, (5, 8, 4)), 2: rng.uniform(20, 30, (5, 8, 4))}
    side[1][0, 0, 0] = side[2][0, :, 0] = -1
    images = {f"{LIDAR}{number}.values": image.ravel() for number, image in side.items()}
    images |= {f"{LIDAR}{number}.shape": image.shape for number, image in side.items()}
    put(broken, "lidar", [{**row, **images, "key.laser_name": 4} for row in rows] + rows)
    lasers = rows_of(broken, "lidar_calibration")
    T = np.array([[0, 1.0, 0, 0.5], [-1, 0, 0, -1], [0, 0, 1, 1], [0, 0, 0, 1]])
    changes = {
        "key.laser_name": 4,
        f"{CALIBRATION}.extrinsic.transform": T.ravel(),
        f"{CALIBRATION}.beam_inclination.values": None,
        f"{CALIBRATION}.beam_inclination.min": -1.5,
        f"{CALIBRATION}.beam_inclination.max": 0.5,
    }
    put(broken, "lidar_calibration", [*lasers, {**lasers[0], **changes}])
    sweep = open_sequence(broken)[1]
    turned = sweep.select(sweep.lidar == 3)
    beams = -1.5 + 2.0 * (np.arange(5) + 0.5) / 5
    expected = [official_points(image.astype(np.float32), beams, T) for image in side.values()]
    np.testing.assert_allclose(turned.points, np.concatenate(expected), atol=1e-5)
    assert len(turned) == 39 + 32 and not turned.offset_ns.any()
    np.testing.assert_allclose(sweep.scanner_origins[3], T[:3, 3])
    np.testing.assert_allclose(sweep.R_scanner_lidar[3], T[:3, :3].T)
