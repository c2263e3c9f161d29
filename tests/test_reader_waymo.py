# SPDX-License-Identifier: MIT
"""The Waymo reader on a street written as a segment and against the published formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from writers.waymo import T_EGO_LIDAR, pixels

from densify.geometry.poses import inverse
from densify.readers import describe, open_sequence
from densify.readers.waymo import Waymo
from tests.reader_checks import check_cameras, check_image_poses, check_truth
from tests.recorded import FRAMES

pyarrow, parquet = (pytest.importorskip(name) for name in ("pyarrow", "pyarrow.parquet"))

FORMAT = "waymo"
LIDAR, CALIBRATION = "[LiDARComponent].range_image_return", "[LiDARCalibrationComponent]"


def change(root, component, edit):
    """Replace the rows of a table by those that ``edit`` returns."""
    path = root / component / "street.parquet"
    table = parquet.read_table(path)
    rows = edit(table.to_pylist())
    parquet.write_table(pyarrow.Table.from_pylist(rows, schema=table.schema), path)


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


def official_points(image, inclinations, extrinsic):
    """compute_range_image_polar, _cartesian of waymo_open_dataset/utils/range_image_utils.py, pixel
    by pixel."""
    width, correction = image.shape[1], np.arctan2(extrinsic[1, 0], extrinsic[0, 0])
    points = []
    for v, u in np.argwhere(image[..., 0] > 0):
        ratio, rise = (width - u - 0.5) / width, inclinations[::-1][v]
        azimuth = (ratio * 2 - 1) * np.pi - correction
        ray = [np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)]
        points.append(extrinsic[:3, :3] @ (image[v, u, 0] * np.array(ray)) + extrinsic[:3, 3])
    return np.array(points)


def test_five_lidars_and_both_returns(broken):
    """A small side lidar with even beams, turned, that hits something twice."""
    rng = np.random.default_rng(0)
    side = {1: rng.uniform(3, 20, (5, 8, 4)), 2: rng.uniform(20, 30, (5, 8, 4))}
    side[1][0, 0, 0] = side[2][0, :, 0] = -1
    images = {f"{LIDAR}{number}.values": image.ravel() for number, image in side.items()}
    images |= {f"{LIDAR}{number}.shape": image.shape for number, image in side.items()}
    images["key.laser_name"] = 4
    change(broken, "lidar", lambda rows: [{**row, **images} for row in rows] + rows)
    T = np.array([[0, 1.0, 0, 0.5], [-1, 0, 0, -1], [0, 0, 1, 1], [0, 0, 0, 1]])
    changes = {
        "key.laser_name": 4,
        f"{CALIBRATION}.extrinsic.transform": T.ravel(),
        f"{CALIBRATION}.beam_inclination.values": None,
        f"{CALIBRATION}.beam_inclination.min": -1.5,
        f"{CALIBRATION}.beam_inclination.max": 0.5,
    }
    change(broken, "lidar_calibration", lambda rows: [*rows, {**rows[0], **changes}])
    sweep = open_sequence(broken)[1]
    turned = sweep.select(sweep.lidar == 3)
    beams = -1.5 + 2.0 * (np.arange(5) + 0.5) / 5
    expected = [official_points(image.astype(np.float32), beams, T) for image in side.values()]
    np.testing.assert_allclose(turned.points, np.concatenate(expected), atol=1e-5)
    assert len(turned) == 39 + 32 and not turned.offset_ns.any()
    np.testing.assert_allclose(sweep.scanner_origins[3], T[:3, 3])
    np.testing.assert_allclose(sweep.R_scanner_lidar[3], T[:3, :3].T)
