# SPDX-License-Identifier: MIT
"""Maps completed with priors of known faults: exact depth of a street, made worse."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from densify.config import resolve
from densify.config.errors import InputError
from densify.depth.prior import complete
from densify.geometry.types import Float, LidarSequence, Prior
from densify.pipeline import run as pipeline
from densify.scores.depth_metrics import DepthErrors, depth_errors

_BLUR_PX, _WANDER_PX = 3.0, 60.0
_SEED = 0


class _Fault(NamedTuple):
    """value: exact depth -> the prior's value. scaled: value -> depth by the true kind and scale
    alone, without a shift. wanders, noise: standard deviations of the logarithm, of an error that
    wanders over 60 px and of one in every pixel that is added after all is blurred by 3 px."""

    value: Callable[[Float], Float]
    scaled: Callable[[Float], Float]
    wanders: float = 0.0
    noise: float = 0.0


FAULTS = {
    "3 x depth, 10 % that wanders": _Fault(lambda z: 3 * z, lambda v: v / 3, wanders=0.1),
    "7 / depth + 0.4": _Fault(lambda z: 7 / z + 0.4, lambda v: 7 / v),
    "7 / depth + 0.4, 10 % that wanders, 5 % in every pixel": _Fault(
        lambda z: 7 / z + 0.4, lambda v: 7 / v, wanders=0.1, noise=0.05
    ),
    "3 x depth, 5 % in every pixel": _Fault(lambda z: 3 * z, lambda v: v / 3, noise=0.05),
}
"""What priors are made of exact depth, all of them blurred by 3 px."""


class Completed(NamedTuple):
    """The pixels that came from the prior: share of the image, and their errors with the true
    kind and scale alone, and as fitted and corrected."""

    share: float
    scaled: DepthErrors
    fitted: DepthErrors


def bench_priors(sequence: LidarSequence, key: int, camera: str) -> dict[str, Completed]:
    """The key's map of a camera completed with each of `FAULTS`.

    Same input, same numbers. Raises InputError for a recording without exact truth.
    """
    if sequence.truth is None:
        raise InputError(
            "priors are made of exact truth: got a recording without, expected a street"
        )
    config = resolve(None)
    made = pipeline.compare(sequence, key, cameras=[camera], config=config, methods=["flow"])
    maps = made["flow"].depth[camera]
    true_m = sequence.truth.depth_m(camera, key).astype(float)
    sky = true_m == 0
    safe_m = np.where(sky, true_m.max(), true_m)
    rng = np.random.default_rng(_SEED)
    wander = gaussian_filter(rng.standard_normal(true_m.shape), _WANDER_PX)
    wander /= wander.std()
    noise = rng.standard_normal(true_m.shape)
    focal_px = float(sequence.cameras[camera].K[0, 0])
    found = {}
    for name, fault in FAULTS.items():
        value = _blurred(fault.value(safe_m * np.exp(fault.wanders * wander)), ~sky)
        value = value * np.exp(fault.noise * noise)
        prior = Prior(np.where(sky, 0, value).astype(np.float32), sky, name)
        full = complete(maps, prior, config.prior.kind)
        scaled_m = np.where(sky, 0, fault.scaled(np.where(sky, 1, value)))
        scaled, fitted = (
            depth_errors(depth_m, true_m, full.from_prior, focal_px=focal_px)
            for depth_m in (scaled_m, full.depth_m)
        )
        found[name] = Completed(float(full.from_prior.mean()), scaled, fitted)
    return found


def _blurred(value: Float, known: np.ndarray) -> Float:
    """(H,W) mean of the known pixels around each, by a Gaussian."""
    weight = gaussian_filter(known.astype(float), _BLUR_PX)
    return gaussian_filter(np.where(known, value, 0), _BLUR_PX) / np.maximum(weight, 1e-9)
