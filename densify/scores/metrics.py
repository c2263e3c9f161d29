# SPDX-License-Identifier: MIT
"""Scores of depth maps, poses, flow and clouds against a ground truth or the sweeps themselves.

Errors of depth follow KITTI's development kit (Uhrig et al., 3DV 2017).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from densify.free_space.range_image import RangeImage
from densify.geometry import poses
from densify.geometry.types import Bool, Camera, Cloud, DepthMap, Float, Float32, Stretch

KITTI_BASELINE_M = 0.54
OUTLIER_PX = 3.0
OUTLIER_FRACTION = 0.05
DECADES = 5.0
"""Confidence 1 means one outlier in 10^5 pixels; each 0.2 less means ten times as many."""
LEAST_PIXELS = 200
"""A share of fewer pixels is no result, and is not shown."""
_DELTA = 1.25
_RANGES_M = (0, 10, 20, 30, 50, 80)
_EDGE_PX = 3
_LEAST_CONFIDENCES = tuple(round(0.05 * step, 2) for step in range(20))


@dataclass(frozen=True)
class DepthErrors:
    """Errors of depth z against the true depth t. An error over no pixels is None."""

    num_pixels: int  # pixels with a true depth
    num_compared: int  # pixels with both depths, over which the errors are taken
    coverage: float | None  # num_compared / num_pixels
    mae_m: float | None  # mean of |z - t|
    rmse_m: float | None  # root mean square of z - t
    imae_per_km: float | None  # mean of |1/z - 1/t|
    irmse_per_km: float | None  # root mean square of 1/z - 1/t
    abs_rel: float | None  # mean of |z - t| / t
    sq_rel: float | None  # mean of (z - t)² / t²
    # Shares of pixels with max(z/t, t/z) < 1.25, 1.25² and 1.25³ (Eigen et al., NIPS 2014)
    delta_1: float | None
    delta_2: float | None
    delta_3: float | None
    # Share of outliers by the rule of KITTI's 2015 stereo benchmark (Menze and Geiger, "Object
    # Scene Flow for Autonomous Vehicles", CVPR 2015)
    outliers: float | None
    outliers_1_px: float | None  # share of pixels whose disparity is off by more than 1 px
    # Standard deviation of ln(z/t), the scale-invariant error (Eigen et al., NIPS 2014)
    silog: float | None


def depth_errors(
    predicted_m: Float | Float32,
    truth_m: Float | Float32,
    mask: Bool | None = None,
    *,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> DepthErrors:
    """Return the errors of depths where both the depth and its ground truth exist.

    A depth z is an outlier if its disparity ``focal_px * baseline_m / z`` differs by more than 3 px
    *and* by more than 5 % from the true disparity.

    Args:
        predicted_m: (H,W) map or (N,) list of depths, camera z in metres, 0 for none.
        truth_m: True depths in the same form. Coverage counts all pixels that have one.
        mask: True for the pixels to score, in the same shape; None for all.
        focal_px: Focal length of the camera.
        baseline_m: Stereo baseline that turns depth into disparity.
    """
    has_truth = truth_m > 0 if mask is None else (truth_m > 0) & mask
    is_compared = has_truth & (predicted_m > 0)
    num_pixels = int(has_truth.sum())
    num_compared = int(is_compared.sum())
    z = predicted_m[is_compared].astype(float)
    t = truth_m[is_compared].astype(float)
    error_m = np.abs(z - t)
    error_per_km = np.abs(1000 / z - 1000 / t)  # difference of inverse depths
    ratio = np.maximum(z / t, t / z)
    return DepthErrors(
        num_pixels=num_pixels,
        num_compared=num_compared,
        coverage=num_compared / num_pixels if num_pixels else None,
        mae_m=mean_or_none(error_m),
        rmse_m=_root_mean_square(error_m),
        imae_per_km=mean_or_none(error_per_km),
        irmse_per_km=_root_mean_square(error_per_km),
        abs_rel=mean_or_none(error_m / t),
        sq_rel=mean_or_none((error_m / t) ** 2),
        delta_1=mean_or_none(ratio < _DELTA),
        delta_2=mean_or_none(ratio < _DELTA**2),
        delta_3=mean_or_none(ratio < _DELTA**3),
        outliers=mean_or_none(is_outlier_depth(z, t, focal_px, baseline_m)),
        outliers_1_px=mean_or_none(focal_px * baseline_m * np.abs(1 / z - 1 / t) > 1),
        silog=float(np.std(np.log(z / t))) if num_compared else None,
    )


def shown_score(scores: Mapping[str, Any], name: str) -> float | None:
    """Return a score of a mapping of `DepthErrors`, None if fewer than 200 pixels count in it."""
    num_pixels = scores.get("num_pixels" if name == "coverage" else "num_compared")
    return scores.get(name) if (num_pixels or 0) >= LEAST_PIXELS else None


def precision_density(
    maps: DepthMap, truth_m: Float32, camera: Camera
) -> list[dict[str, float | None]]:
    """Return density and share of outliers for each least confidence 0, 0.05, … 0.95.

    Each dictionary has ``min_confidence``, and for ``measured`` and ``filled`` depth:
    ``density_*``, share of the pixels that keep a depth; ``outliers_*``, share of outliers among
    the kept pixels with a true depth (``truth_m``); ``expected_*``, share of outliers that the
    confidence of the kept pixels promises. The latter two are None without such pixels.
    """
    curve = []
    for min_confidence in _LEAST_CONFIDENCES:
        is_kept = maps.confidence >= min_confidence
        point: dict[str, float | None] = {"min_confidence": min_confidence}
        for name, depth_m in (("measured", maps.depth_m), ("filled", maps.filled_m)):
            predicted_m = np.where(is_kept, depth_m, np.float32(0))
            errors = depth_errors(predicted_m, truth_m, focal_px=camera.focal_px)
            point[f"density_{name}"] = image_density(predicted_m)
            point[f"outliers_{name}"] = errors.outliers
            kept_confidence = maps.confidence[predicted_m > 0]
            point[f"expected_{name}"] = mean_or_none(outlier_probability(kept_confidence))
        curve.append(point)
    return curve


def errors_by_part(
    predicted_m: Float32,
    truth_m: Float32,
    moving: Bool | None = None,
    *,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> dict[str, DepthErrors]:
    """Return the errors of a depth map for parts of its pixels, by name of the part.

    The parts are ``all`` pixels, ranges of true depth (``0-10 m`` … ``over 80 m``), `depth_edges`
    (``edge``), other pixels (``not edge``) and, given the mask ``moving``, ``moving`` and
    ``static`` pixels. Maps are (H,W), depths are metres, 0 for none.
    """
    known = truth_m > 0
    z, t = predicted_m[known], truth_m[known]
    masks: dict[str, Bool | None] = {"all": None}
    for near_m, far_m in pairwise(_RANGES_M):
        masks[f"{near_m}-{far_m} m"] = (t >= near_m) & (t < far_m)
    masks[f"over {_RANGES_M[-1]} m"] = t >= _RANGES_M[-1]
    edge = depth_edges(truth_m, focal_px=focal_px, baseline_m=baseline_m)[known]
    masks |= {"edge": edge, "not edge": ~edge}
    if moving is not None:
        masks |= {"moving": moving[known], "static": ~moving[known]}
    return {
        name: depth_errors(z, t, mask, focal_px=focal_px, baseline_m=baseline_m)
        for name, mask in masks.items()
    }


def depth_edges(truth_m: Float32, *, focal_px: float, baseline_m: float = KITTI_BASELINE_M) -> Bool:
    """Return a mask (H,W) of the pixels with a true depth (metres) near a depth discontinuity.

    Within 3 px of such a pixel, another true depth would be an outlier at this pixel. Level ground
    is no discontinuity: for a camera 1.65 m above ground, disparity grows by 0.54/1.65 px per row.
    """
    known = truth_m > 0
    disparity_px = np.zeros(truth_m.shape)
    np.divide(focal_px * baseline_m, truth_m, out=disparity_px, where=known)
    size = 2 * _EDGE_PX + 1
    largest = ndimage.maximum_filter(disparity_px, size, mode="constant", cval=0.0)
    holes_out = np.where(known, disparity_px, math.inf)
    smallest = ndimage.minimum_filter(holes_out, size, mode="constant", cval=math.inf)
    edge = np.zeros(truth_m.shape, bool)
    known_px = disparity_px[known]
    edge[known] = _is_outlier(largest[known], known_px) | _is_outlier(smallest[known], known_px)
    return edge


def mean_errors(images: Sequence[DepthErrors]) -> DepthErrors:
    """Return the mean of each error over the images with this error, and the sums of the counts."""
    means: dict[str, Any] = {}
    for field in fields(DepthErrors):
        values = [value for image in images if (value := getattr(image, field.name)) is not None]
        counted = field.name.startswith("num_")
        means[field.name] = sum(values) if counted else mean_or_none(np.array(values))
    return DepthErrors(**means)


def image_density(depth_m: Float32) -> float:
    """Return the share (0 to 1) of the image's pixels that have a depth."""
    return float(np.mean(depth_m > 0)) if depth_m.size else 0.0


def depth_scores(
    depth: DepthMap, truth_depth_m: Float32, moving_mask: Bool, camera: Camera
) -> dict[str, dict[str, dict[str, Any]]]:
    """Return the errors of a depth map: ``measured`` or ``filled`` -> pixels -> name -> error.

    Pixels are ``all``, ``moving`` or ``static``, names those of `DepthErrors`. ``truth_depth_m`` is
    (H,W) metres, 0 for none. ``moving_mask`` (H,W) is True at moving objects.
    """
    return {
        product: scores_by_motion(image, truth_depth_m, moving_mask, camera)
        for product, image in (("measured", depth.depth_m), ("filled", depth.filled_m))
    }


def scores_by_motion(
    depth_m: Float32, truth_depth_m: Float32, moving_mask: Bool, camera: Camera
) -> dict[str, dict[str, Any]]:
    """Return ``all``, ``moving`` or ``static`` pixels -> name in `DepthErrors` -> error of a map.

    Both depths are (H,W) metres, 0 for none. ``moving_mask`` (H,W) is True at moving objects.
    """
    masks = {"all": None, "moving": moving_mask, "static": ~moving_mask}
    return {
        group: asdict(depth_errors(depth_m, truth_depth_m, mask, focal_px=camera.focal_px))
        for group, mask in masks.items()
    }


def shares_by_motion(mask: Bool, moving: Bool) -> dict[str, float | None]:
    """Return the shares of True in ``mask`` (N,) of ``all``, ``moving``, ``static``; else None."""
    parts = {"all": mask, "moving": mask[moving], "static": mask[~moving]}
    return {name: mean_or_none(part) for name, part in parts.items()}


def outlier_probability(confidence: Float | Float32) -> Float:
    """Return the probability that a pixel of some confidence is an outlier by KITTI's rule.

    It is ``10 ** (-5 * confidence)``, in the shape of ``confidence``. A pixel value v above 0 of a
    confidence PNG means the confidence ``(v - 1) / 254``.
    """
    return 10.0 ** (-DECADES * np.asarray(confidence, np.float64))


def is_outlier_depth(
    predicted_m: Float | Float32,
    truth_m: Float | Float32,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> Bool:
    """Return a mask (N,), True where a depth (N,) above 0 is an outlier by KITTI's rule."""
    disparity_m_px = focal_px * baseline_m
    predicted_px = disparity_m_px / predicted_m.astype(np.float64)
    return _is_outlier(predicted_px, disparity_m_px / truth_m.astype(np.float64))


def _is_outlier(disparity_px: Float, true_px: Float) -> Bool:
    """Return (N,) True where a disparity is an outlier by KITTI's rule."""
    error_px = np.abs(disparity_px - true_px)
    return (error_px > OUTLIER_PX) & (error_px > OUTLIER_FRACTION * true_px)


def mean_or_none(values: np.ndarray) -> float | None:
    """Return the mean, None for no values."""
    return float(np.mean(values)) if len(values) else None


def _root_mean_square(values: Float) -> float | None:
    """Return the root mean square, None for no values."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


# Tolerance over half a second; an error of 1 % shifts surfaces by 0.1 m over 10 m.
_OFF_M, _OFF_PER_M, _OFF_DEG = 0.03, 0.01, 0.3


def window_pose_errors(
    stretch: Stretch, key: int, T_world_lidar: Callable[[int], Float]
) -> tuple[float, float]:
    """Return the root mean square errors of a window's poses relative to the key's: m, degrees.

    ``T_world_lidar`` returns the true (4,4) pose of a frame.
    """
    T_key_world = poses.inverse(T_world_lidar(key))
    true = T_key_world @ np.stack([T_world_lidar(frame) for frame in stretch.frames])
    estimated = np.stack([stretch.T_target_source(key, frame) for frame in stretch.frames])
    T_error = poses.inverse(true) @ estimated
    squared_m2 = T_error[:, :3, 3] ** 2
    squared_rad2 = poses.log(T_error)[:, :3] ** 2
    error_m, error_rad = (
        np.sqrt(squared.sum(axis=1).mean()) for squared in (squared_m2, squared_rad2)
    )
    return float(error_m), float(np.rad2deg(error_rad))


class RecordedError(NamedTuple):
    """Error of recorded motions against odometry."""

    m: float  # median translation error in metres
    deg: float  # median rotation error in degrees
    cost: float  # the larger error, as a multiple of its tolerance
    way_m: float  # length of the longest motion by odometry

    @staticmethod
    def of(recorded: Sequence[Float], odometry: Sequence[Float]) -> RecordedError:
        """Compare recorded motions (4,4), each over one stretch of sweeps, with odometry's."""
        T_recorded, T_odometry = np.stack(recorded), np.stack(odometry)
        difference = poses.log(poses.inverse(T_recorded) @ T_odometry)
        way_m = np.linalg.norm(T_odometry[:, :3, 3], axis=1)
        error_rad, error_m = (np.linalg.norm(half, axis=1) for half in np.hsplit(difference, 2))
        error_deg = float(np.rad2deg(np.median(error_rad)))
        cost_m = float(np.median(error_m / (_OFF_M + _OFF_PER_M * way_m)))
        cost = max(cost_m, error_deg / _OFF_DEG)
        return RecordedError(float(np.median(error_m)), error_deg, cost, float(way_m.max()))


def main_error(
    recorded: Sequence[Float], odometry: Sequence[Float], duration_s: float
) -> tuple[str, str]:
    """Return two clauses: the main error of recorded motions against odometry, and its correction.

    The error is a scale, or a drift over ``duration_s`` seconds. Without a known correction the
    second clause is "". Motions are (4,4), each over one stretch of sweeps.
    """
    recorded_m, odometry_m = (
        np.array([T[:3, 3] for T in motions]) for motions in (recorded, odometry)
    )
    off_m, way_m = (recorded_m - odometry_m).mean(axis=0), odometry_m.mean(axis=0)
    # Errors in different directions have no common cause: then their mean is short.
    if np.linalg.norm(off_m) < 0.5 * np.linalg.norm(recorded_m - odometry_m, axis=1).mean():
        mistake = "; no usual mistake explains it (another frame than the points', another clock,"
        return f"{mistake} or noise)", ""
    # Error along the way, as a share of the way: a scale if it makes up most of the error
    longer = float(off_m @ way_m / (way_m @ way_m))
    if abs(longer) * np.linalg.norm(way_m) > 0.7 * np.linalg.norm(off_m):
        sense = "long" if longer > 0 else "short"
        mistake = f": their ways are {abs(longer) * 100:.1f} % too {sense}"
        return mistake, f"divide their translations by {1 + longer:.3f}, or "
    axis = int(np.argmax(np.abs(off_m)))
    direction = (("forward", "back"), ("left", "right"), ("up", "down"))[axis][int(off_m[axis] < 0)]
    return f": they go {abs(off_m[axis]) / duration_s:.2f} m/s {direction} beside the sweeps", ""


STRICT, RELAXED = 0.05, 0.1
"""Limits of `accuracy`, both in metres and as a share of the true flow's length."""
CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "OBJECT")
"""The challenge's classes; a point's class is the index. OBJECT is an object of unknown kind."""
IGNORED = 255
"""Class number of points that the challenge leaves out, such as signs."""
_WITHIN_M = 35.0  # the challenge's range, on each side of the vehicle
_MOVES_M = 0.05  # flow of a moving point, per sweep
_EDGES_M = np.linspace(0, 2.0, 51)  # lower edges of the buckets; the first holds static points


def end_point_errors(estimated: Float, true: Float) -> Float:
    """Return the end-point errors (N,), |estimated - true| in metres, of flows (N,3)."""
    return np.linalg.norm(np.asarray(estimated, np.float64) - np.asarray(true, np.float64), axis=1)


def end_point_error(estimated: Float, true: Float, mask: Bool | None = None) -> float:
    """Return the mean end-point error in metres of (N,3) flows, over ``mask`` (N,) if given."""
    error_m = end_point_errors(estimated, true)
    return mean_of(error_m if mask is None else error_m[mask])


def accuracy(estimated: Float, true: Float, limit: float) -> float:
    """Return the share of points whose end-point error is below a limit; flows (N,3) are metres.

    The limit is ``limit`` metres or, if larger, ``limit`` times the length of the true flow.
    """
    error_m = end_point_errors(estimated, true)
    return mean_of((error_m < limit) | (error_m < limit * np.linalg.norm(true, axis=1)))


def angle_error_rad(estimated: Float, true: Float) -> float:
    """Return the mean angle in radians between estimated and true flows (N,3).

    Points whose true flow is 0 do not count. An estimate of 0 counts as a right angle.
    """
    length_m = np.linalg.norm(true, axis=1)
    flow, truth, length_m = (values[length_m > 0] for values in (estimated, true, length_m))
    lengths = np.linalg.norm(flow, axis=1) * length_m
    dot = np.einsum("nd,nd->n", flow, truth)
    cosine = np.divide(dot, lengths, out=np.zeros(len(flow)), where=lengths > 0)
    return mean_of(np.arccos(np.clip(cosine, -1.0, 1.0)))


def mean_of(values: Float | Bool) -> float:
    """Return the mean of the values, NaN if there are none."""
    return float(values.mean()) if len(values) else float("nan")


def challenge_scores(
    points: Float, estimated: Float, true: Float, classes: NDArray[Any]
) -> dict[str, Any]:
    """Score flow as the Argoverse 2 scene flow challenges do, within 35 m of the vehicle.

    Args:
        points: (N,3) metres, vehicle frame, without ground.
        estimated: (N,3) estimated flow in metres.
        true: (N,3) true flow.
        classes: (N,) indices in `CLASSES`, or `IGNORED`.

    Returns:
        ``three_way``: mean errors in metres of moving objects (0.05 m a sweep or more), of other
            objects, of the static background, and the mean of the three (Chodosh, Ramanan, Lucey,
            WACV 2024; the package av2). ``bucketed``: for each class with points and MEAN,
            ``static_m``, the mean error in the first bucket of true flow, and ``dynamic``, the mean
            over the others of error divided by true length (Khatri et al., "I Can't Believe It's
            Not Scene Flow!", ECCV 2024; the package bucketed-scene-flow-eval). ``num_points``:
            number of scored points.
    """
    scored = np.abs(points[:, :2]).max(axis=1, initial=0) < _WITHIN_M
    scored &= classes < len(CLASSES)
    error_m = end_point_errors(estimated, true)[scored]
    length_m = np.linalg.norm(np.asarray(true, np.float64), axis=1)[scored]
    class_number = classes[scored].astype(np.intp)
    moves, is_object = length_m >= _MOVES_M, class_number > 0
    three_way = {
        "foreground_dynamic_m": mean_of(error_m[is_object & moves]),
        "foreground_static_m": mean_of(error_m[is_object & ~moves]),
        "background_static_m": mean_of(error_m[~is_object & ~moves]),
    }
    three_way["mean_m"] = sum(three_way.values()) / len(three_way)
    bucket = np.digitize(length_m, _EDGES_M) - 1
    bucketed = {
        CLASSES[number]: _bucketed(
            *(column[class_number == number] for column in (error_m, length_m, bucket))
        )
        for number in np.unique(class_number)
    }
    means = {}
    for name in ("static_m", "dynamic"):
        column = np.array([row[name] for row in bucketed.values()], np.float64)
        means[name] = mean_of(column[np.isfinite(column)])
    return {
        "three_way": three_way,
        "bucketed": {**bucketed, "MEAN": means},
        "num_points": int(scored.sum()),
    }


def _bucketed(error_m: Float, length_m: Float, bucket: NDArray[np.intp]) -> dict[str, float]:
    """Return the two scores of one class with points."""
    # Sums over the points of each bucket but the first
    errors, lengths = (
        np.bincount(bucket, values, len(_EDGES_M))[1:] for values in (error_m, length_m)
    )
    filled = lengths > 0
    quotients = errors[filled] / lengths[filled]
    return {"static_m": mean_of(error_m[bucket == 0]), "dynamic": mean_of(quotients)}


_GHOST_MARGIN_M, _GHOST_MARGIN_FRACTION, _MIN_FILLED = 0.5, 0.02, 6


def ghosts(cloud: Cloud, key_image: RangeImage, key: int) -> tuple[Bool, Bool]:
    """Return two masks (M,) of a cloud: ghosts, and points that the key sweep cannot judge.

    At a ghost's position, all returns of the key sweep in its cell and the eight around it, at
    least six, are farther by more than max(0.5 m, 2 % of its range). Dark paint and glass hide
    ghosts. Points of the key sweep and of sweeps beyond the window are False in both masks.
    """
    ghost, unjudged = np.zeros((2, len(cloud)), bool)
    rows = np.flatnonzero(_others(cloud, key))
    margins_m = (_GHOST_MARGIN_M, _GHOST_MARGIN_FRACTION)
    beyond = key_image.count_beyond(
        cloud.points[rows], margins_m, _MIN_FILLED, cloud.velocity_m_s[rows]
    )
    ghost[rows] = (beyond >= _MIN_FILLED).any(axis=0)
    unjudged[rows] = (beyond == 0).all(axis=0)
    return ghost, unjudged


def ghost_rate(cloud: Cloud, key_image: RangeImage, key: int) -> float | None:
    """Return the share of `ghosts` among the window's points of other sweeps; None without any."""
    return mean_or_none(ghosts(cloud, key_image, key)[0][_others(cloud, key)])


def ghost_scores(cloud: Cloud, key_image: RangeImage, key: int) -> dict[str, Any]:
    """Return the shares of `ghosts` among the ``num_points`` points of the window's other sweeps.

    The shares are of ``all``, ``moving`` and ``static`` points, and of points by frames
    (``by_distance["3"]``) and by seconds (``by_seconds["0.30"]``) from the key sweep. ``unjudged``
    has the shares of points that the key sweep cannot judge.
    """
    rows = np.flatnonzero(_others(cloud, key))
    ghost, unjudged = (mask[rows] for mask in ghosts(cloud, key_image, key))
    moving = cloud.moving[rows]
    distance = np.abs(cloud.frame[rows] - key)
    hundredths = np.rint(np.abs(cloud.since_key_ns[rows]) / 1e7).astype(np.int64)
    return {
        "num_points": len(rows),
        **shares_by_motion(ghost, moving),
        "unjudged": shares_by_motion(unjudged, moving),
        "by_distance": {str(steps): rate for steps, rate in _rates(ghost, distance).items()},
        "by_seconds": {f"{h / 100:.2f}": rate for h, rate in _rates(ghost, hundredths).items()},
    }


def _others(cloud: Cloud, key: int) -> Bool:
    """Return (M,) True for points of the window that are not from the key sweep."""
    return (cloud.frame != key) & ~cloud.far


def _rates(ghost: Bool, group: NDArray[np.integer]) -> dict[int, float]:
    """Return the share of ghosts in each group number (N,) that has points, ascending."""
    num_points, num_ghosts = np.bincount(group), np.bincount(group, ghost)
    return {g: float(num_ghosts[g] / num_points[g]) for g in np.flatnonzero(num_points).tolist()}
