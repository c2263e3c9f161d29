# SPDX-License-Identifier: MIT
"""Small results in memory and on disk, with cameras of every kind, for tests of outputs."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.depth.views import with_ages
from densify.geometry.types import Camera, CameraView, Cloud, DepthMap, Result, StageCost
from densify.outputs.finished_run import export_run
from densify.outputs.key_outputs import write_result
from densify.pipeline.run import run, run_keys
from tests.small_street import KEY, POSES_GIVEN, one_car

H, W = 12, 20
CAMERAS = ("image_02", "image_03")
KEY_NS = 1_317_046_451_123_456_000  # 2011-09-26 14:14:11
STAMPS_NS = {119: KEY_NS - 100_000_000, 120: KEY_NS, 121: KEY_NS + 100_000_000}
LATE_S = 0.01
NUM_POINTS = 400
LENSES = {
    "plain": ("pinhole", ()),
    "bent": ("pinhole", (-0.31, 0.12, 0.001, -0.002)),
    "bent5": ("pinhole", (-0.31, 0.12, 0.001, -0.002, 0.03)),
    "bent8": ("pinhole", (-0.3, 0.1, 0.001, -0.002, 0.03, 0.2, -0.1, 0.05)),
    "prism": ("pinhole", (-0.3, 0.1, 0.001, -0.002, 0.03, 0.2, -0.1, 0.05, 0.01)),
    "fisheye": ("fisheye", (0.02, -0.01, 0.003, -0.0004)),
    "mei": ("mei", (1.2, 0.1, 0.2, 0.0, 0.0)),
}


def map_of(camera: str, seed: int = 0) -> DepthMap:
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((H, W)) < 0.4, rng.uniform(2, 300, (H, W)), 0).astype(np.float32)
    filled = np.where(depth > 0, depth, np.float32(rng.random() * 30))
    filled[0] = depth[0]
    frame = np.where(depth > 0, rng.integers(119, 122, (H, W)), -1).astype(np.int32)
    bare = DepthMap(camera, depth, filled, rng.random((H, W), dtype=np.float32), frame)
    return with_ages(bare, STAMPS_NS, 120, LATE_S)


def cloud_of(num_points: int = NUM_POINTS, seed: int = 3) -> Cloud:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-110, 110, (num_points, 3))
    moving = rng.random(num_points) < 0.4
    frame = rng.choice([*STAMPS_NS], num_points).astype(np.int32)
    return Cloud(
        points=points,
        rigid_points=points - rng.normal(0, 2, (num_points, 3)) * moving[:, None],
        frame=frame,
        since_key_ns=np.array([STAMPS_NS[f] - KEY_NS for f in frame.tolist()], np.int64),
        row=np.arange(num_points),
        lidar=np.zeros(num_points, np.uint8),
        moving=moving,
        instance=np.where(moving, rng.integers(0, 9, num_points), -1).astype(np.int32),
        velocity_m_s=np.zeros((num_points, 3), np.float32),
        confidence=rng.random(num_points, dtype=np.float32),
        intensity=rng.random(num_points, dtype=np.float32),
        rgb=rng.integers(0, 256, (num_points, 3), np.uint8) * (rng.random((num_points, 1)) < 0.8),
        far=rng.random(num_points) < 0.3,
    )


def result_of(
    method: str = "flow", seed: int = 0, cameras: tuple[str, ...] = CAMERAS, **metrics: Any
) -> Result:
    return Result(
        method=method,
        key=120,
        frames=(119, 120, 121),
        cloud=cloud_of(seed=3 + seed),
        depth={name: map_of(name.partition("/")[0], seed + i) for i, name in enumerate(cameras)},
        metrics=metrics,
        costs=(StageCost("register", 1.23456, 512.34), StageCost("flow", 2.0, 600.0)),
        stamp_ns=KEY_NS,
    )


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
    return CameraView(camera, turn @ camera.T_cam_lidar, LATE_S, 120)


def write_views(
    out: Path, lenses: dict[str, str], measure: str = "z", **changes: Any
) -> tuple[Path, Result]:
    """The folder of a run with a map for each name, and its result. lenses: by the maps' names,
    CAMERA or CAMERA/NUMBER. changes: of the result."""
    names = tuple(lenses)
    rng = np.random.default_rng(1)
    images = {name: rng.integers(0, 256, (H, W, 3), np.uint8) for name in names}
    result = replace(
        result_of(cameras=names, measure=dict.fromkeys(names, measure)),
        images=images,
        **{
            "views": {n: view_of(n.partition("/")[0], lenses[n], i) for i, n in enumerate(names)},
            "T_key_lidar": {frame: np.eye(4) for frame in STAMPS_NS},
            **changes,
        },
    )
    write_result(result, out, config={}, data="street")
    return out / "000120", result


@cache
def street_result() -> Result:
    """A street with a car that moves, densified from three sweeps, and scored."""
    return run(one_car(), KEY, 1, config=POSES_GIVEN | {"output": {"score": True}})


@cache
def drive_results() -> dict[int, Result]:
    """Two neighbouring keys of that street."""
    results = dict(run_keys(one_car(), [KEY, KEY + 1], 1, config=POSES_GIVEN))
    assert all(isinstance(result, Result) for result in results.values())
    return results  # type: ignore[return-value]


def write_drive(out: Path) -> Path:
    """The folder with the keys of `drive_results`."""
    for result in drive_results().values():
        write_result(result, out, config={}, data="tiny street")
    return out


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones included, with its bytes."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


@contextmanager
def refusal(*parts: object) -> Iterator[None]:
    """The block fails in one line that names these parts."""
    with pytest.raises(InputError) as error:
        yield
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message, message


def refused(*parts: object, run: Path, **arguments: Any) -> None:
    """The export fails in one line that names these parts, and the run stays as it was."""
    before = tree(run)
    with refusal(*parts):
        export_run(run, **arguments)
    assert tree(run) == before
