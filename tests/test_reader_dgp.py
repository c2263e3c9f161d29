# SPDX-License-Identifier: MIT
"""The DGP reader on a street written as a scene and on a real DDAD scene."""

from __future__ import annotations

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.readers import open_sequence
from densify.readers.dgp import Dgp
from tests.reader_checks import check_cameras, check_truth
from tests.recorded import CAMERA, FRAMES

FORMAT = "dgp"


def test_the_street_is_given_back(written, excerpt):
    sequence, street = open_sequence(written), excerpt.street
    assert isinstance(sequence, Dgp) and list(sequence.frames) == [0, 1, 2]
    check_cameras(sequence, excerpt)
    check_truth(sequence, excerpt)
    T_lidar_cam = inverse(street.cameras[CAMERA].T_cam_lidar)
    for number, frame in enumerate(FRAMES):
        sweep, true = sequence[number], street.truth.sweep(frame)
        assert sweep.stamp_ns == sequence.stamp_ns(number) == street.stamp_ns(frame)
        assert sweep.offset_ns is None and sweep.scanner_origins is None
        still = ~true.moving
        np.testing.assert_allclose(sweep.points[still], true.points[still], atol=1e-4)
        np.testing.assert_array_equal(sweep.intensity, street[frame].intensity)
        T_world_lidar = street.T_world_lidar(frame)
        np.testing.assert_allclose(sequence.T_world_lidar(number), T_world_lidar, atol=1e-9)
        at_image = sequence.T_world_cam(CAMERA, number)
        np.testing.assert_allclose(at_image, T_world_lidar @ T_lidar_cam, atol=1e-9)


def test_scenes(written, test_data):
    assert open_sequence(written.parent).name == "scene_01"
    assert open_sequence(f"dgp:{written.parent}#scene_01").name == "scene_01"
    with pytest.raises(InputError, match="no recording scene_02; choose one"):
        open_sequence(f"dgp:{written.parent}#scene_02")
    with pytest.raises(InputError, match="no DGP scene"):
        open_sequence(f"dgp:{written / 'rgb'}")


# A real scene


def test_a_real_scene(test_data):
    sequence = open_sequence(test_data / "ddad")
    assert list(sequence.frames) == [0, 1, 2]
    assert list(sequence.cameras) == [f"CAMERA_0{n}" for n in (1, 5, 6, 7, 8, 9)]
    # names of files are tenths of microseconds
    assert sequence.stamp_ns(0) == 1_561_645_825_002_790_000
    assert sequence.image_stamps_ns("CAMERA_05")[2] == 1_561_645_825_193_647_200
    front = sequence.cameras["CAMERA_01"]
    assert (front.width_px, front.height_px, front.K[0, 0]) == (1936, 1216, 2181.530254382263)
    T_ego_cam = inverse(front.T_cam_lidar)
    np.testing.assert_allclose(T_ego_cam[:3, 3], [1.48554, 0.28616, 1.56173], atol=1e-5)
    np.testing.assert_allclose(T_ego_cam[:3, 2], [1, 0, 0], atol=0.1)  # looks ahead
    sweep = sequence[0]
    path = test_data / "ddad/scene_02/point_cloud/LIDAR/15616458250027900.npz"
    stored = np.load(path)["data"]
    assert len(sweep) == len(stored) == 47_230
    np.testing.assert_array_equal(sweep.points, stored[:, :3])
    np.testing.assert_allclose(sweep.intensity, stored[:, 3], atol=1e-7)
    # the mean of the six places in the calibration
    np.testing.assert_allclose(sweep.scanner_origins, [[1.14779, 0.07166, 1.55299]], atol=1e-5)
    poses = [sequence.T_world_lidar(n)[:3, 3] for n in range(3)]
    np.testing.assert_allclose(poses[0], [111.45486, -2261.38424, -12.73396], atol=1e-5)
    steps_m = np.linalg.norm(np.diff(poses, axis=0), axis=1)
    np.testing.assert_allclose(steps_m, 1.26, atol=0.03)
    # an image's pose is where the vehicle, 12.7 m/s fast, was 2 to 3 ms before the sweep's stamp
    for name, camera in sequence.cameras.items():
        T_lidar_world, T_lidar_cam = inverse(sequence.T_world_lidar(1)), inverse(camera.T_cam_lidar)
        at_image = T_lidar_world @ sequence.T_world_cam(name, 1)
        np.testing.assert_allclose(T_lidar_cam[1:3, 3], at_image[1:3, 3], atol=0.001)
        assert 0.002 < (T_lidar_cam - at_image)[0, 3] / 12.7 < 0.003
