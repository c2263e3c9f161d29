# SPDX-License-Identifier: MIT
"""How good a result is: depth against truth, ghosts without any truth, flow against truth.

Every ``*_scores`` and ``*_errors`` dictionary holds plain numbers ready for JSON; what is undefined
(an error over no pixels) is None, never NaN.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from densify.errors import InputError
from densify.range_image import RangeImage
from densify.types import Bool, Camera, Cloud, DepthMap, Float32

KITTI_BASELINE_M = 0.54
_OUTLIER_PX = 3.0
_OUTLIER_FRACTION = 0.05
_GHOST_MARGIN_M = 0.5
_GHOST_MARGIN_FRACTION = 0.02


@dataclass(frozen=True)
class DepthErrors:
    """Depth against truth.

    num_pixels: with a truth. num_compared: of those, with a predicted depth too; the errors are
    over these. coverage: num_compared / num_pixels. mae_m, rmse_m: mean absolute and root mean
    square error of depth (Uhrig et al., "Sparsity Invariant CNNs", 3DV 2017). outliers: the
    *fraction* (0 to 1) of compared pixels that are wrong by the rule of KITTI's 2015 stereo
    benchmark (Menze and Geiger, "Object Scene Flow for Autonomous Vehicles", CVPR 2015).
    """

    num_pixels: int
    num_compared: int
    coverage: float | None
    mae_m: float | None
    rmse_m: float | None
    outliers: float | None


def depth_errors(
    predicted_m: Float32,
    truth_m: Float32,
    mask: Bool | None = None,
    *,
    focal_px: float,
    baseline_m: float = KITTI_BASELINE_M,
) -> DepthErrors:
    """Errors of a depth map where truth exists and ``mask`` (all if None) is True.

    predicted_m, truth_m: (H,W) camera z in metres, 0 none. A pixel is an outlier when its disparity
    d = focal_px · baseline_m / z is off by more than 3 px *and* by more than 5 % of the true one.
    ``focal_px`` is the camera's fx; the default baseline is KITTI's, so that numbers compare.
    Raises InputError if the shapes differ.
    """
    for name, image in (("truth", truth_m), ("mask", mask)):
        if image is not None and image.shape != predicted_m.shape:
            raise InputError(
                f"depth errors: {name}: expected the depth map's shape {predicted_m.shape}, got "
                f"{image.shape}; give maps of the same camera"
            )
    known = truth_m > 0 if mask is None else (truth_m > 0) & mask
    compared = known & (predicted_m > 0)
    num_pixels, num_compared = int(known.sum()), int(compared.sum())
    z = predicted_m[compared].astype(float)
    z_true = truth_m[compared].astype(float)
    d, d_true = focal_px * baseline_m / z, focal_px * baseline_m / z_true
    off_px = np.abs(d - d_true)
    wrong = (off_px > _OUTLIER_PX) & (off_px > _OUTLIER_FRACTION * d_true)
    return DepthErrors(
        num_pixels=num_pixels,
        num_compared=num_compared,
        coverage=num_compared / num_pixels if num_pixels else None,
        mae_m=_mean(np.abs(z - z_true)),
        rmse_m=float(np.sqrt(np.mean((z - z_true) ** 2))) if num_compared else None,
        outliers=_mean(wrong),
    )


def image_density(depth_m: Float32) -> float:
    """Fraction (0 to 1) of all the image's pixels that have a depth."""
    return float(np.mean(depth_m > 0)) if depth_m.size else 0.0


def depth_scores(
    depth: DepthMap, truth_depth_m: Float32, moving_mask: Bool, camera: Camera
) -> dict[str, dict[str, dict[str, Any]]]:
    """`depth_errors` as ``scores["measured"|"filled"]["all"|"moving"|"static"]``.

    truth_depth_m: (H,W) metres, 0 none. moving_mask: (H,W), True where a moving thing shows.
    Measured and filled stay apart: a filled pixel costs little and says less.
    """
    masks = {"all": None, "moving": moving_mask, "static": ~moving_mask}
    return {
        product: {
            part: asdict(depth_errors(image, truth_depth_m, mask, focal_px=camera.K[0, 0]))
            for part, mask in masks.items()
        }
        for product, image in (("measured", depth.depth_m), ("filled", depth.filled_m))
    }


def ghosts(cloud: Cloud, key_image: RangeImage, key: int) -> Bool:
    """(M,) bool: points of other sweeps standing where the key sweep saw through.

    A point is a ghost when it lies clearly in front of what the key sweep measured in its direction
    and in all 8 neighbouring directions, by more than max(0.5 m, 2 % of its range); directions
    without a return say nothing, but six of the nine must have one.
    """
    ghost = np.zeros(len(cloud), bool)
    other = cloud.frame != key
    ghost[other] = key_image.sees_through(
        cloud.points[other],
        _GHOST_MARGIN_M,
        _GHOST_MARGIN_FRACTION,
        min_filled=6,
        velocity_m_s=cloud.velocity_m_s[other],
    )
    return ghost


def ghost_rate(cloud: Cloud, key_image: RangeImage, key: int) -> float | None:
    """Fraction of the accumulated points that are `ghosts`, over all not from the key sweep."""
    return _mean(ghosts(cloud, key_image, key)[cloud.frame != key])


def ghost_scores(cloud: Cloud, key_image: RangeImage, key: int) -> dict[str, Any]:
    """Needs no truth: ``num_points`` of other sweeps and the `ghost_rate` of ``all`` of them, of
    those the flow calls ``moving`` and of the ``static`` rest, and by distance in frames from the
    key (``by_distance["3"]``: frames key-3 and key+3)."""
    other = cloud.frame != key
    ghost = ghosts(cloud, key_image, key)
    distance = np.abs(cloud.frame - key)
    return {
        "num_points": int(other.sum()),
        "all": _mean(ghost[other]),
        "moving": _mean(ghost[other & cloud.moving]),
        "static": _mean(ghost[other & ~cloud.moving]),
        "by_distance": {
            str(steps): _mean(ghost[distance == steps]) for steps in np.unique(distance[other])
        },
    }


def held_out_scores(
    rest: Mapping[str, DepthMap],
    key_alone: Mapping[str, DepthMap],
    moving: Mapping[str, Bool],
    cameras: Mapping[str, Camera],
) -> dict[str, Any]:
    """The key densified from its neighbours alone against the key sweep's own returns, by camera;
    the fields of `depth_scores`. Needs no truth.

    rest: maps of the cloud without the key sweep. key_alone: maps of the key sweep alone. moving:
    (H,W) where its returns belong to something that moves.
    """
    return {
        name: depth_scores(maps, key_alone[name].depth_m, moving[name], cameras[name])
        for name, maps in rest.items()
    }


def _mean(values: np.ndarray) -> float | None:
    return float(np.mean(values)) if len(values) else None
