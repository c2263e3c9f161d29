# SPDX-License-Identifier: MIT
"""Small runs on disk with cameras of every kind, for the tests of exports."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry.types import Camera, CameraView, Result
from densify.outputs import write_result
from densify.pipeline.run import run
from tests.small_street import KEY, POSES_GIVEN, one_car
from tests.test_export import KEY_NS, H, W, map_of
from tests.test_export_formats import cloud_of

LENSES = {
    "plain": ("pinhole", ()),
    "bent": ("pinhole", (-0.31, 0.12, 0.001, -0.002)),
    "bent5": ("pinhole", (-0.31, 0.12, 0.001, -0.002, 0.03)),
    "bent8": ("pinhole", (-0.3, 0.1, 0.001, -0.002, 0.03, 0.2, -0.1, 0.05)),
    "prism": ("pinhole", (-0.3, 0.1, 0.001, -0.002, 0.03, 0.2, -0.1, 0.05, 0.01)),
    "fisheye": ("fisheye", (0.02, -0.01, 0.003, -0.0004)),
    "mei": ("mei", (1.2, 0.1, 0.2, 0.0, 0.0)),
}


def camera_of(name: str, lens: str) -> Camera:
    model, distortion = LENSES[lens]
    K = np.array([[17.25, 0, 9.125], [0, 18.5, 5.75], [0, 0, 1]])
    T_cam_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    return Camera(name, W, H, K, T_cam_lidar, distortion, model)


def view_of(name: str, lens: str, seed: int) -> CameraView:
    camera, turn = camera_of(name, lens), np.eye(4)
    rng = np.random.default_rng(seed)
    turn[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
    turn[:3, 3] = rng.normal(0, 1, 3)
    return CameraView(camera, turn @ camera.T_cam_lidar, 0.01, 120)


def write_views(out: Path, lenses: dict[str, str], measure: str = "z") -> tuple[Path, Result]:
    """A run's folder with a map for each of the names, and the result. lenses: by the maps' names,
    CAMERA or CAMERA/NUMBER."""
    names = list(lenses)
    views = {n: view_of(n.partition("/")[0], lens, i) for i, (n, lens) in enumerate(lenses.items())}
    rng = np.random.default_rng(1)
    images = {name: rng.integers(0, 256, (H, W, 3), np.uint8) for name in names}
    result = Result(
        method="flow",
        key=120,
        frames=(119, 120, 121),
        cloud=cloud_of(),
        depth={name: map_of(name.partition("/")[0], i) for i, name in enumerate(names)},
        metrics={"measure": dict.fromkeys(names, measure)},
        images=images,
        stamp_ns=KEY_NS,
        views=views,
        T_key_lidar={frame: np.eye(4) for frame in (119, 120, 121)},
    )
    write_result(result, images, out, config={}, data="street")
    return out / "000120", result


@cache
def street_result() -> Result:
    """A street with a car that moves, densified from three sweeps."""
    return run(one_car(), KEY, 1, config=POSES_GIVEN)


def write_street(out: Path) -> Path:
    """The folder of `street_result`."""
    result = street_result()
    write_result(result, result.images, out, config={}, data="tiny street")
    return out / f"{KEY:06d}"
