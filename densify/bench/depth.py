# SPDX-License-Identifier: MIT
"""Compare depth maps with every ground truth: ``densify bench depth``, ``densify evaluate``.

Ground truths by name. ``truth``: exact depth of a simulated recording below the scanner's top ring
and within 80 m. ``key held out``: returns of the key sweep, for a map made from the other sweeps.
``scanner``: returns of one of several scanners, which the maps do not use.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from itertools import product as cartesian
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from densify.config import Config
from densify.config.errors import InputError
from densify.depth.exposure import Exposure, Shot, key_shots
from densify.geometry import poses
from densify.geometry.cameras import convert_depth, depth_along, rays
from densify.geometry.types import (
    Bool,
    Camera,
    Float,
    Float32,
    LidarSequence,
    Progress,
    Result,
    Sweep,
)
from densify.outputs.depth_png import read_depth_png, read_mask_png
from densify.pipeline import run as pipeline
from densify.pipeline.key_result import METHODS, looks_around
from densify.pipeline.process import Watch
from densify.pipeline.recording import Recording
from densify.readers.depth_trees import DepthPair, DepthPairs
from densify.readers.timeline import choose_cameras
from densify.scores.metrics import (
    KITTI_BASELINE_M,
    DepthErrors,
    errors_by_part,
    image_density,
    is_outlier_depth,
    mean_errors,
)

PRODUCTS = ("measured", "filled")
_GROUPS = ("all", "moving")  # of pixels
_REACH_M = 80.0
_TOP_QUANTILE = 0.999
_HIDING_PX = 11  # a return of the other scanner behind a nearer return may be occluded
_HIDING_FRACTION, _HIDING_M = 0.03, 0.2
_OUTLIER_M, _OUTLIER_FRACTION = 0.3, 0.05  # of a scanner's truth
_STEREO_BASELINE_M = 0.532725  # of the drives of 2011_09_26


class TruthMap(NamedTuple):
    """True depth of an image."""

    depth_m: Float32  # (H,W) true depth in metres, 0 for no depth
    moving: Bool  # (H,W) bool, True at pixels of moving objects
    # True to count outliers by KITTI's rule (error above 3 px of disparity and 5 %). False to count
    # errors above 0.3 m and 5 %.
    by_disparity: bool
    baseline_m: float = KITTI_BASELINE_M  # stereo baseline that turns depth into disparity

    def outliers(self, depth_m: Float32, focal_px: float) -> Bool:
        """Return a mask (H,W) of a depth map's outliers, False where either map has no depth."""
        known = (self.depth_m > 0) & (depth_m > 0)
        judged_m, true_m = (m[known].astype(np.float64) for m in (depth_m, self.depth_m))
        outliers = np.zeros(known.shape, bool)
        if self.by_disparity:
            outliers[known] = is_outlier_depth(judged_m, true_m, focal_px, self.baseline_m)
        else:
            error_m = np.abs(judged_m - true_m)
            outliers[known] = (error_m > _OUTLIER_M) & (error_m > _OUTLIER_FRACTION * true_m)
        return outliers


class Altered:
    """A recording with altered or fewer sweeps or other recorded poses; all else is as recorded.

    ``sweep`` alters each sweep. ``T_world_lidar`` maps a frame to its pose. None changes nothing.
    """

    def __init__(
        self,
        sequence: Any,
        sweep: Callable[[Sweep], Sweep] | None = None,
        T_world_lidar: Callable[[int], Float] | None = None,
        frames: Sequence[int] | None = None,
    ) -> None:
        self._sequence, self._alter = sequence, sweep
        self.frames = sequence.frames if frames is None else frames
        if T_world_lidar is not None:
            self.T_world_lidar = T_world_lidar

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def __getitem__(self, frame: int) -> Sweep:
        sweep: Sweep = self._sequence[frame]
        return sweep if self._alter is None else self._alter(sweep)


def without_scanner(sequence: LidarSequence, scanner: int) -> Any:
    """Return a recording without the returns of the scanner with this index."""
    return Altered(sequence, lambda sweep: sweep.select(sweep.lidar != scanner))


def scanner_truth(
    scanner: int, recording: Recording, key: int, shots: Mapping[str, Shot]
) -> dict[str, TruthMap]:
    """Return the depth measured by one scanner in the key sweep, by name of the map.

    ``scanner`` is its index, ``key`` the key's frame number, ``shots`` are the views by map name.
    Returns that a nearer return beside them may occlude are left out.
    """
    sequence = recording.sequence
    config = recording.settings
    cloud = recording.moment(key, all_sweeps=True, engine="").cloud
    cloud = cloud.select((cloud.lidar == scanner) & (cloud.frame == key))
    stretch = recording.window(key)
    maps = {}
    for name, shot in shots.items():
        view = Exposure.of(sequence, stretch, key, shot, config).view_of(cloud)
        depth_m = view.exposure.depth_m(view.points_cam)
        # The nearest return of a pixel is written last.
        farthest_first = np.argsort(-depth_m, kind="stable")
        column, row = np.rint(view.uv[farthest_first]).astype(np.int64).T
        shape = (shot.camera.height_px, shot.camera.width_px)
        nearest_m, moving = np.zeros(shape, np.float32), np.zeros(shape, bool)
        nearest_m[row, column] = depth_m[farthest_first]
        moving[row, column] = cloud.moving[view.rows[farthest_first]]
        # Returns far behind a nearer return beside them may be occluded.
        front_m = ndimage.minimum_filter(
            np.where(nearest_m > 0, nearest_m, np.float32(np.inf)), _HIDING_PX
        )
        nearest_m[nearest_m > (1 + _HIDING_FRACTION) * front_m + _HIDING_M] = 0
        maps[name] = TruthMap(nearest_m, moving, by_disparity=False)
    return maps


def exact_truth(
    sequence: LidarSequence, key_sweep: Sweep, shots: Mapping[str, Shot], config: Config
) -> dict[str, TruthMap]:
    """Return map name -> exact depth within 80 m below the top ring; {} without exact truth.

    Maps that show no image are left out.
    """
    maps: dict[str, TruthMap] = {}
    if sequence.truth is None:
        return maps
    from_scanner = key_sweep.points
    if key_sweep.scanner_origins is not None:
        from_scanner = from_scanner - key_sweep.scanner_origins[key_sweep.lidar]
    slope = from_scanner[:, 2] / np.linalg.norm(from_scanner[:, :2], axis=1)
    top_slope = np.quantile(slope, _TOP_QUANTILE)
    for name, shot in shots.items():
        if shot.number is None:
            continue
        camera, number = shot.camera, shot.number
        depth_m = sequence.truth.depth_m(camera.name, number)
        v, u = np.nonzero((depth_m > 0) & (depth_m <= _REACH_M))
        ray = rays(camera, np.stack([u, v], 1).astype(np.float64))
        range_m = depth_m[v, u] / depth_along(ray, camera.measure)
        points = poses.transform(poses.inverse(camera.T_cam_lidar), ray * range_m[:, None])
        below = points[:, 2] <= top_slope * np.linalg.norm(points[:, :2], axis=1)
        known_m = np.zeros_like(depth_m)
        known_m[v[below], u[below]] = depth_m[v[below], u[below]]
        moving = sequence.truth.moving_mask(camera.name, number)
        measure = config.project.depth if config.project.depth != "auto" else camera.measure
        known_m = convert_depth(camera, known_m, camera.measure, measure)
        maps[name] = TruthMap(known_m, moving, by_disparity=True)
    return maps


def stereo_truth(folder: Path, frame: int, camera: Camera) -> TruthMap:
    """Return the depth of KITTI's 2015 stereo benchmark, whose moving cars are whole models.

    ``folder`` has ``frameN_disparity.png`` (uint16, 256 × disparity in px, 0 for none) and
    ``frameN_objects.png`` (above 0 at moving cars), of the left colour camera. Source: Menze and
    Geiger, "Object Scene Flow for Autonomous Vehicles", CVPR 2015.
    """
    disparity_px = read_depth_png(folder / f"frame{frame}_disparity.png")
    depth_m = np.zeros_like(disparity_px)
    known = disparity_px > 0
    depth_m[known] = camera.focal_px * _STEREO_BASELINE_M / disparity_px[known]
    moving = read_mask_png(folder / f"frame{frame}_objects.png")
    return TruthMap(depth_m, moving, True, _STEREO_BASELINE_M)


def agrees_beside(truth: TruthMap, depth_m: Float32, reach_px: int, focal_px: float) -> Bool:
    """Return a mask (H,W), True where a true depth beside, in the same row, agrees with a map.

    Args:
        depth_m: (H,W) depth in metres of the map, 0 for none.
        reach_px: Greatest distance along the row.
        focal_px: Focal length, which outliers by disparity depend on.
    """
    agrees = np.zeros(depth_m.shape, bool)
    for shift in range(-reach_px, reach_px + 1):
        beside = truth._replace(depth_m=np.roll(truth.depth_m, shift, axis=1))
        agrees |= (beside.depth_m > 0) & (depth_m > 0) & ~beside.outliers(depth_m, focal_px)
    return agrees


def bench_depth(
    sequence: LidarSequence,
    keys: Sequence[int],
    window: int,
    variants: Mapping[str, Config],
    cameras: Sequence[str] | None = None,
    scanner: int | None = None,
    method: str = "flow",
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Densify the key sweeps with each variant, and pool the scores over key sweeps and cameras.

    Args:
        keys: Frame numbers of the key sweeps.
        window: Number of sweeps on each side of a key sweep.
        variants: Name -> settings to compare.
        cameras: Names of the cameras, None for all.
        scanner: Index of the scanner whose returns are the ground truth, None for none.
        method: Name of a method in `densify.pipeline.key_result.METHODS`.

    Returns:
        Under ``variants`` by name: ``density``, mean share of pixels with a depth in the measured
            and the filled map; ``seconds`` of projection per key sweep; ``scores`` (num_pixels,
            coverage, outliers) by ground truth, map (measured, filled) and pixels (all, moving).
    """
    chosen = choose_cameras(sequence, cameras)
    if method not in METHODS:
        raise InputError(f"--method {method}: expected one of {', '.join(METHODS)}")
    if scanner is not None and not np.any(sequence[keys[0]].lidar == scanner):
        raise InputError(f"--scanner {scanner}: no returns of it in sweep {keys[0]}")
    used = sequence if scanner is None else without_scanner(sequence, scanner)
    sums = {name: _Sums() for name in variants}
    for number, key in enumerate(keys):
        for name, config in variants.items():
            shots = key_shots(sequence, chosen, key, config.project)
            truths = {}
            if scanner is not None:
                whole = Recording(sequence, config, window, [key], looks_around=True)
                truths["scanner"] = scanner_truth(scanner, whole, key, shots)
            watch = Watch()
            looks = looks_around([method])
            recording = Recording(used, config.scored(), window, [key], None, None, watch, looks)
            result = pipeline.densify(recording, key, [method], cameras, watch)[method]
            key_sweep = recording.window(key)[key].sweep
            truths["truth"] = exact_truth(used, key_sweep, shots, config)
            sums[name].add(result, truths, used.cameras)
        if progress is not None:
            progress("bench", number + 1, len(keys))
    numbers = {name: variant.numbers(len(keys)) for name, variant in sums.items()}
    return {"data": sequence.name, "keys": list(keys), "scanner": scanner, "variants": numbers}


class _Sums:
    """Sums of pixel counts over key sweeps and cameras, by ground truth, map and pixels."""

    def __init__(self) -> None:
        # Pixels with a true depth, those that have a depth in the map too, outliers among these
        self._counts: defaultdict[tuple[str, str, str], Any] = defaultdict(lambda: np.zeros(3, int))
        self._densities: defaultdict[str, list[float]] = defaultdict(list)
        self._seconds = 0.0

    def add(
        self,
        result: Result,
        truths: Mapping[str, Mapping[str, TruthMap]],
        cameras: Mapping[str, Camera],
    ) -> None:
        """Add the maps of a result. ``truths``: name of the ground truth -> map -> true depth."""
        self._seconds += sum(cost.seconds for cost in result.costs if cost.name == "project")
        for name, maps in result.depth.items():
            focal_px = cameras[maps.camera].focal_px
            for product, depth_m in zip(PRODUCTS, (maps.depth_m, maps.filled_m), strict=True):
                self._densities[product].append(image_density(depth_m))
                truth_of = {
                    title: of_maps[name] for title, of_maps in truths.items() if name in of_maps
                }
                for truth_name, truth in truth_of.items():
                    known, outliers = truth.depth_m > 0, truth.outliers(depth_m, focal_px)
                    masks = np.stack([known, known & (depth_m > 0), outliers])
                    num_moving = masks[:, truth.moving].sum(axis=1)
                    self._counts[truth_name, product, "all"] += masks.sum(axis=(1, 2))
                    self._counts[truth_name, product, "moving"] += num_moving
        for scores in (result.metrics.get("held_out") or {}).values():
            for product, group in cartesian(PRODUCTS, _GROUPS):
                score = scores[product][group]
                num_outliers = round((score["outliers"] or 0.0) * score["num_compared"])
                counts = (score["num_pixels"], score["num_compared"], num_outliers)
                self._counts["key held out", product, group] += counts

    def numbers(self, num_keys: int) -> dict[str, Any]:
        """Return density, seconds and scores of a variant, as `bench_depth` returns them."""
        scores: dict[str, Any] = {}
        for (truth_name, product, group), counts in self._counts.items():
            num_pixels, num_compared, num_outliers = counts.tolist()
            scores.setdefault(truth_name, {}).setdefault(product, {})[group] = {
                "num_pixels": num_pixels,
                "coverage": num_compared / num_pixels if num_pixels else None,
                "outliers": num_outliers / num_compared if num_compared else None,
            }
        density = {product: float(np.mean(shares)) for product, shares in self._densities.items()}
        return {"density": density, "seconds": self._seconds / num_keys, "scores": scores}


SCHEMA_VERSION = 1
"""Version of `evaluate`'s dictionary. It grows when an entry changes its meaning or is removed."""
_AGREEMENT = 0.05  # of a map and its truth in most pixels
_MILLIMETRES = 1000 / 256  # factor between the two usual scales of stored depth
KITTI_FOCAL_PX = 721.5377
"""Focal length of KITTI's rectified cameras on 2011_09_26. On other days it is 707 to 719 px."""


def evaluate(
    pairs: DepthPairs,
    focal_px: float = KITTI_FOCAL_PX,
    baseline_m: float = KITTI_BASELINE_M,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Return the scores of depth maps, averaged over images as in KITTI's development kit.

    The result has plain numbers ready for JSON, None if undefined::

        schema_version, focal_px, baseline_m, num_images
        density      predicted, truth: mean share of all the pixels that have a depth
        parts        name of `errors_by_part` -> num_images and the values of `mean_errors`
        images       for each pair: predicted, truth, mask (paths or None), density, `DepthErrors`
        without_truth, without_prediction, without_mask   paths of files without a partner

    Disparity, which defines outliers and depth discontinuities, is focal length times baseline over
    depth. ``progress`` is called with (stage, done, total).
    """
    stereo = {"focal_px": focal_px, "baseline_m": baseline_m}
    by_part: dict[str, list[DepthErrors]] = defaultdict(list)
    images: list[dict[str, Any]] = []
    for number, pair in enumerate(pairs.pairs):
        predicted_m, truth_m, moving = _read(pair)
        _check_unit(pair, predicted_m, truth_m)
        errors = errors_by_part(predicted_m, truth_m, moving, **stereo)
        for name, of_part in errors.items():
            by_part[name].append(of_part)
        paths = {side: None if path is None else str(path) for side, path in vars(pair).items()}
        densities = {"predicted": image_density(predicted_m), "truth": image_density(truth_m)}
        images.append({**paths, "density": densities, **asdict(errors["all"])})
        if progress is not None:
            progress("evaluate", number + 1, len(pairs.pairs))
    return {
        "schema_version": SCHEMA_VERSION,
        **stereo,
        "num_images": len(images),
        "density": {
            side: float(np.mean([image["density"][side] for image in images]))
            for side in ("predicted", "truth")
        },
        "parts": {
            name: {"num_images": sum(e.num_compared > 0 for e in errors)}
            | asdict(mean_errors(errors))
            for name, errors in by_part.items()
        },
        "images": images,
        "without_truth": [*map(str, pairs.without_truth)],
        "without_prediction": [*map(str, pairs.without_prediction)],
        "without_mask": [*map(str, pairs.without_mask)],
    }


def _check_unit(pair: DepthPair, predicted_m: Float32, truth_m: Float32) -> None:
    """Raise InputError if one of two maps stores 1000 x metres instead of 256 x metres."""
    compared = (predicted_m > 0) & (truth_m > 0)
    if not compared.any():
        return
    ratio = predicted_m[compared] / truth_m[compared]
    for path, too_large in ((pair.predicted, ratio), (pair.truth, 1 / ratio)):
        quartiles = np.percentile(too_large, [25, 50, 75])
        if np.abs(quartiles / _MILLIMETRES - 1).max() < _AGREEMENT:
            raise InputError(
                f"{path}: holds depths {quartiles[1]:.2f} times those of the other map, as if it "
                f"stored 1000 x metres (millimetres); expected 256 x metres: multiply its values "
                f"by 0.256"
            )


def _read(pair: DepthPair) -> tuple[Float32, Float32, Bool | None]:
    """Return (H,W) predicted metres, (H,W) true metres, and an (H,W) mask of moving pixels."""
    predicted_m, truth_m = read_depth_png(pair.predicted), read_depth_png(pair.truth)
    moving = None if pair.mask is None else read_mask_png(pair.mask)
    for path, image in ((pair.predicted, predicted_m), (pair.mask, moving)):
        if image is not None and image.shape != truth_m.shape:
            raise InputError(
                f"{path}: got {image.shape[1]} x {image.shape[0]} px, expected "
                f"{truth_m.shape[1]} x {truth_m.shape[0]}, the size of {pair.truth}; give maps of "
                f"the same camera, neither cropped nor scaled"
            )
    return predicted_m, truth_m, moving
