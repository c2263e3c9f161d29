# SPDX-License-Identifier: MIT
"""Results as other libraries have them in memory."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.geometry.types import Cloud
from tests.exported import camera_of, cloud_of, map_of, street_result, view_of

NAMES = (
    *("x", "y", "z", "rigid_x", "rigid_y", "rigid_z", "frame", "since_key_ns", "row", "lidar"),
    *("moving", "instance", "velocity_x", "velocity_y", "velocity_z", "confidence", "intensity"),
    *("red", "green", "blue", "far"),
)
VECTORS = {
    "points": ("x", "y", "z"),
    "rigid_points": ("rigid_x", "rigid_y", "rigid_z"),
    "velocity_m_s": ("velocity_x", "velocity_y", "velocity_z"),
    "rgb": ("red", "green", "blue"),
}


def check(cloud: Cloud, column) -> None:
    """column: by name -> (M,) as the other library has it."""
    for field, values in vars(cloud).items():
        for i, name in enumerate(VECTORS.get(field, [field])):
            own = values[:, i] if field in VECTORS else values
            np.testing.assert_array_equal(column(name), own, err_msg=name)
            assert np.asarray(column(name)).dtype == own.dtype, name


@pytest.mark.parametrize("num_points", [0, 1, 300])
def test_to_numpy_holds_everything(num_points):
    cloud = cloud_of(num_points)
    rows = cloud.to_numpy()
    assert rows.shape == (num_points,) and rows.dtype.names == NAMES
    check(cloud, rows.__getitem__)


def test_a_map_s_points_project_onto_their_pixels():
    view, maps = view_of("image_02", "plain", 4), map_of("image_02", 1)
    for filled, depth_m in ((True, maps.filled_m), (False, maps.depth_m)):
        points = maps.to_points(view, filled)
        points_cam = points @ view.T_cam_key[:3, :3].T + view.T_cam_key[:3, 3]
        uvw = points_cam @ view.camera.K.T
        v, u = np.nonzero(depth_m)
        np.testing.assert_allclose(points_cam[:, 2], depth_m[v, u], rtol=1e-6)
        np.testing.assert_allclose(uvw[:, :2] / uvw[:, 2:], np.stack([u, v], axis=1), atol=1e-6)
        assert len(points) == (depth_m > 0).sum() > 20


def test_a_street_s_map_lies_on_its_cloud():
    from scipy.spatial import cKDTree

    result = street_result()
    points = result.depth["front"].to_points(result.views["front"], filled=False)
    off_m, _ = cKDTree(result.cloud.points).query(points)
    assert len(points) > 3000 and np.median(off_m) < 0.1 and np.mean(off_m < 0.5) > 0.98


def test_maps_whose_points_are_not_known():
    maps, view = map_of("image_02", 1), view_of("image_02", "plain", 4)
    for lens in ("bent", "fisheye", "mei"):
        bent = replace(view, camera=camera_of("image_02", lens))
        with pytest.raises(InputError, match=r"image_02: to_points\(\) needs a rectified pinhole"):
            maps.to_points(bent)
    with pytest.raises(InputError, match="depth as range"):
        replace(maps, measure="range").to_points(view)
