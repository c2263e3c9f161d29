# SPDX-License-Identifier: MIT
"""Return the true depth of the maps of a key sweep, from each kind of ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from densify.config import Config
from densify.config.cache import Cache
from densify.depth.exposure import Exposure, Shot
from densify.geometry import poses
from densify.geometry.cameras import converted, depth_along, rays
from densify.geometry.types import Bool, Camera, Float32, LidarSequence, Sweep
from densify.outputs.depth_png import read_depth_png, read_mask_png
from densify.pipeline.recording import Recording
from densify.scores.depth_metrics import KITTI_BASELINE_M, is_outlier_depth

_REACH_M = 80.0
_TOP_QUANTILE = 0.999
_HIDING_PX = 11  # a return of the other scanner behind a nearer return may be occluded
_HIDING_FRACTION, _HIDING_M = 0.03, 0.2
_WRONG_M, _WRONG_FRACTION = 0.3, 0.05
_STEREO_BASELINE_M = 0.532725  # of the drives of 2011_09_26


class TruthMap(NamedTuple):
    """True depth of an image."""

    depth_m: Float32  # (H,W) true depth in metres, 0 for no depth
    moving: Bool  # (H,W) bool, True at pixels of moving objects
    # True to count outliers by KITTI's rule (error above 3 px of disparity and 5 %). False to count
    # errors above 0.3 m and 5 %.
    by_disparity: bool
    baseline_m: float = KITTI_BASELINE_M  # stereo baseline that turns depth into disparity

    def outliers(self, depth_m: Float32, known: Bool, focal_px: float) -> Bool:
        """Return (K,) True where the depth (H,W) is an outlier at the K pixels ``known`` (H,W)."""
        z, t = depth_m[known].astype(np.float64), self.depth_m[known].astype(np.float64)
        if self.by_disparity:
            return is_outlier_depth(z, t, focal_px, self.baseline_m)
        wrong: Bool = (np.abs(z - t) > _WRONG_M) & (np.abs(z - t) > _WRONG_FRACTION * t)
        return wrong


class Without:
    """A recording without the returns of one scanner."""

    def __init__(self, sequence: LidarSequence, scanner: int) -> None:
        self._sequence, self._scanner = sequence, scanner

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def __getitem__(self, frame: int) -> Sweep:
        sweep = self._sequence[frame]
        return sweep.select(sweep.lidar != self._scanner)


def scanner_truth(
    scanner: int,
    sequence: LidarSequence,
    key: int,
    window: int,
    shots: Mapping[str, Shot],
    config: Config,
    cache: Cache | None = None,
) -> dict[str, TruthMap]:
    """Return the depth measured by one scanner in the key sweep, by name of the map."""
    recording = Recording(sequence, config, window, [key], cache, looks_around=True)
    cloud = recording.moment(key, all_sweeps=True, engine="").cloud
    cloud = cloud.select((cloud.lidar == scanner) & (cloud.frame == key))
    stretch = recording.window(key)
    maps = {}
    for name, shot in shots.items():
        view = Exposure.of(sequence, stretch, key, shot, config).sees(cloud)
        depth_m = view.exposure.depth_m(view.points_cam)
        farthest_first = np.argsort(-depth_m, kind="stable")
        column, row = np.rint(view.uv[farthest_first]).astype(np.int64).T
        shape = (shot.camera.height_px, shot.camera.width_px)
        nearest_m, moving = np.zeros(shape, np.float32), np.zeros(shape, bool)
        nearest_m[row, column] = depth_m[farthest_first]
        moving[row, column] = cloud.moving[view.rows[farthest_first]]
        before_m = ndimage.minimum_filter(
            np.where(nearest_m > 0, nearest_m, np.float32(np.inf)), _HIDING_PX
        )
        nearest_m[nearest_m > (1 + _HIDING_FRACTION) * before_m + _HIDING_M] = 0
        maps[name] = TruthMap(nearest_m, moving, by_disparity=False)
    return maps


def exact_truth(
    sequence: LidarSequence, key_sweep: Sweep, shots: Mapping[str, Shot], config: Config
) -> dict[str, TruthMap]:
    """Return the exact depth within range and view of the scanner, {} for a real recording."""
    maps: dict[str, TruthMap] = {}
    if sequence.truth is None:
        return maps
    away = key_sweep.points
    if key_sweep.scanner_origins is not None:
        away = away - key_sweep.scanner_origins[key_sweep.lidar]
    top = np.quantile(away[:, 2] / np.linalg.norm(away[:, :2], axis=1), _TOP_QUANTILE)
    for name, shot in shots.items():
        if shot.number is None:
            continue
        camera, number = shot.camera, shot.number
        depth_m = sequence.truth.depth_m(camera.name, number)
        v, u = np.nonzero((depth_m > 0) & (depth_m <= _REACH_M))
        ray = rays(camera, np.stack([u, v], 1).astype(np.float64))
        scale = depth_m[v, u] / depth_along(ray, camera.measure)
        lidar = poses.transform(poses.inverse(camera.T_cam_lidar), ray * scale[:, None])
        below = lidar[:, 2] <= top * np.linalg.norm(lidar[:, :2], axis=1)
        known_m = np.zeros_like(depth_m)
        known_m[v[below], u[below]] = depth_m[v[below], u[below]]
        moving = sequence.truth.moving_mask(camera.name, number)
        measure = config.project.depth if config.project.depth != "auto" else camera.measure
        known_m = converted(camera, known_m, camera.measure, measure)
        maps[name] = TruthMap(known_m, moving, by_disparity=True)
    return maps


def stereo_truth(folder: Path, frame: int, camera: Camera) -> TruthMap:
    """Return the depth of KITTI's 2015 stereo benchmark, whose moving cars are whole models.

    ``folder`` has ``frameN_disparity.png`` (uint16, 256 × disparity in px, 0 for none) and
    ``frameN_objects.png`` (above 0 at moving cars). ``camera`` is the left colour camera. Source:
    Menze and Geiger, "Object Scene Flow for Autonomous Vehicles", CVPR 2015.
    """
    disparity_px = read_depth_png(folder / f"frame{frame}_disparity.png")
    depth_m = np.zeros_like(disparity_px)
    known = disparity_px > 0
    depth_m[known] = camera.focal_px * _STEREO_BASELINE_M / disparity_px[known]
    moving = read_mask_png(folder / f"frame{frame}_objects.png")
    return TruthMap(depth_m, moving, True, _STEREO_BASELINE_M)


def agrees_beside(truth: TruthMap, depth_m: Float32, reach_px: int, focal_px: float) -> Bool:
    """Return (H,W) True where the true depth agrees within ``reach_px`` along the row."""
    agrees = np.zeros(depth_m.shape, bool)
    for shift in range(-reach_px, reach_px + 1):
        beside = truth._replace(depth_m=np.roll(truth.depth_m, shift, axis=1))
        known = (beside.depth_m > 0) & (depth_m > 0)
        agrees[known] |= ~beside.outliers(depth_m, known, focal_px)
    return agrees
