# SPDX-License-Identifier: MIT
"""What every reader must give back of a street that was written in its format."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from writers.excerpt import Excerpt

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.geometry.types import LidarSequence
from densify.readers import open_sequence


def check_sweeps(
    sequence: LidarSequence,
    excerpt: Excerpt,
    reference_ns: int = 0,
    T_lidar_ego: np.ndarray | None = None,
    point_m: float = 1e-6,
    offset_ns: int = 1,
    clock_ns: int = 0,
) -> None:
    """Points as they were fired, their times, scanners, intensities and the poses.

    clock_ns: what the format's clock says more than the street's. reference_ns: how much later than
    the street's the format's reference time is. T_lidar_ego: the frame in which the format has the
    points. point_m, offset_ns: what the format rounds.
    """
    street = excerpt.street
    T_ego_lidar = np.eye(4) if T_lidar_ego is None else inverse(T_lidar_ego)
    assert list(sequence.frames) == list(range(len(excerpt.frames)))
    T_world_ego = excerpt.T_world_ego(
        np.array([street.stamp_ns(f) + reference_ns for f in excerpt.frames]), T_lidar_ego
    )
    first = inverse(sequence.T_world_lidar(0))
    for number, frame in enumerate(excerpt.frames):
        read, true = sequence[number], street[frame]
        assert sequence.stamp_ns(number) == read.stamp_ns == true.stamp_ns + reference_ns + clock_ns
        assert len(read) == len(true)
        moved = transform(T_ego_lidar, true.points)
        np.testing.assert_allclose(read.points, moved, atol=point_m)
        assert np.abs(read.offset_ns + reference_ns - true.offset_ns).max() <= offset_ns
        np.testing.assert_array_equal(read.lidar, true.lidar)
        np.testing.assert_allclose(read.intensity, true.intensity, atol=1 / 255)
        step = first @ sequence.T_world_lidar(number)
        np.testing.assert_allclose(step, inverse(T_world_ego[0]) @ T_world_ego[number], atol=1e-5)


def check_cameras(
    sequence: LidarSequence,
    excerpt: Excerpt,
    T_lidar_ego: np.ndarray | None = None,
    stamp_ns: int = 1,
    same_pixels: bool = True,
    place_m: float = 1e-6,
    names: Mapping[str, str] | None = None,
    clock_ns: int = 0,
) -> None:
    """Calibration (the camera's place to ``place_m``), exposure times (to ``stamp_ns``) and images;
    lossy formats need not have the same pixels. names: what the format calls the street's cameras,
    if not the same. clock_ns: what its clock says more than the street's."""
    street = excerpt.street
    T_ego = np.eye(4) if T_lidar_ego is None else T_lidar_ego
    called = {name: (names or {}).get(name, name) for name in excerpt.cameras}
    assert set(sequence.cameras) == set(called.values())
    for name in excerpt.cameras:
        read, true = sequence.cameras[called[name]], street.cameras[name]
        assert (read.width_px, read.height_px) == (true.width_px, true.height_px)
        assert read.model == true.model
        np.testing.assert_allclose(read.K, true.K, atol=1e-6)
        np.testing.assert_allclose(read.T_cam_lidar, true.T_cam_lidar @ T_ego, atol=place_m)
        numbers, exposed_ns = excerpt.image_numbers(name), sequence.image_stamps_ns(called[name])
        assert list(exposed_ns) == list(range(len(numbers)))
        for number, image in enumerate(numbers):
            late_ns = exposed_ns[number] - street.image_stamps_ns(name)[image] - clock_ns
            assert abs(late_ns) <= stamp_ns
            got, expected = sequence.image(called[name], number), street.image(name, image)
            assert got.shape == expected.shape
            if same_pixels:
                np.testing.assert_array_equal(got, expected)
            else:
                assert np.abs(got.astype(int) - expected).mean() < 4


def check_image_poses(
    sequence: LidarSequence,
    excerpt: Excerpt,
    atol: float,
    names: Mapping[str, str] | None = None,
) -> None:
    """The pose of a camera at each exposure; names as in `check_cameras`."""
    street = excerpt.street
    for name in excerpt.cameras:
        T_lidar_cam = inverse(street.cameras[name].T_cam_lidar)
        for number, image in enumerate(excerpt.image_numbers(name)):
            exposed_ns = street.image_stamps_ns(name)[image]
            expected = street.simulator.T_world_lidar_at(exposed_ns) @ T_lidar_cam
            read = sequence.T_world_cam((names or {}).get(name, name), number)
            np.testing.assert_allclose(read, expected, atol=atol)


def check_truth(sequence: LidarSequence, excerpt: Excerpt) -> None:
    """The truth beside the data belongs to its rows."""
    truth = sequence.truth
    assert truth is not None
    for number in range(len(excerpt.frames)):
        sweep, true = sequence[number], truth.sweep(number)
        assert len(true.points) == sweep.row.max() + 1
        away_m = np.linalg.norm(true.points[sweep.row] - sweep.points, axis=1)
        assert np.median(away_m) < 4.0 and away_m.max() < 12.0  # the vehicle moves in a sweep
        still = ~true.moving[sweep.row]
        flow = truth.displacement(number, 0)[sweep.row]
        assert not flow[still].any() or np.linalg.norm(flow[still], axis=1).max() < 0.06


def check_refused(spec: object, says: str, place: object = "", frame: int | None = None) -> None:
    """Opening the recording and reading a sweep (the first), its pose and an image of each camera
    ends in one line that names the place."""
    with pytest.raises(InputError, match=says) as error:
        sequence = open_sequence(str(spec))
        frame = sequence.frames[0] if frame is None else frame
        _ = sequence[frame]
        for camera in sequence.cameras:
            for number in [*sequence.image_stamps_ns(camera)][:1]:
                sequence.image(camera, number)
        sequence.T_world_lidar(frame)
    assert "\n" not in str(error.value) and str(place) in str(error.value)
