# SPDX-License-Identifier: MIT
"""Complete the depth maps of a result with depth images that the user supplies (priors)."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from densify.config.errors import InputError
from densify.depth.exposure import Shot
from densify.depth.prior import MAX_WRONG, complete
from densify.geometry.types import Bool, Float32, Prior, Result
from densify.readers.prior_files import PriorFiles
from densify.scores import depth_metrics

_log = logging.getLogger("densify")


def complete_with_prior(
    result: Result,
    files: PriorFiles,
    shots: Mapping[str, Shot],
    truth: Mapping[str, tuple[Float32, Bool]],
    kind: str,
) -> Result:
    """Return the result with completed maps (``full``) and their scores.

    A prior that does not fit the measured depth is not used, and a warning is logged. ``shots`` and
    ``truth``, depth (H,W) in metres and mask (H,W) of moving pixels, are by map name. ``kind`` is
    the setting ``prior.kind``.
    """
    full, metrics = {}, copy.deepcopy(dict(result.metrics))
    for name, prior in _read(files, shots, result.key).items():
        full[name] = maps = complete(result.depth[name], prior, kind)
        if not maps.fit.used:
            _log.warning(
                "key %d: the prior %s is not used, depth_full is as depth_filled: after the best "
                "fit %.0f %% of the measured pixels are off by more than 25 %%, expected at most "
                "%.0f %%",
                result.key,
                maps.source,
                100 * maps.fit.wrong,
                100 * MAX_WRONG,
            )
        prior_alone_m = np.where(maps.from_prior, maps.depth_m, np.float32(0))
        for product, depth_m in (("full", maps.depth_m), ("prior", prior_alone_m)):
            metrics["density"][name][product] = depth_metrics.image_density(depth_m)
            if name in truth:
                metrics["depth"][name][product] = depth_metrics.scores_by_motion(
                    depth_m, *truth[name], shots[name].camera
                )
    return replace(result, full=full, metrics=metrics)


def _read(files: PriorFiles, shots: Mapping[str, Shot], key: int) -> dict[str, Prior]:
    """Return map name -> prior, read by image number, or by key if the map shows no image."""
    priors, lacking = {}, []
    for name, shot in shots.items():
        number = key if shot.number is None else shot.number
        prior = files.prior(shot.camera, number)
        if prior is not None:
            priors[name] = prior
        else:
            lacking.append(f"{shot.camera.name} {number} ({files.said_of(shot.camera.name)})")
    if lacking and not priors:
        raise InputError(f"--prior {files.place}: key {key}: no depth image {', '.join(lacking)}")
    if lacking:
        _log.warning("key %d: no depth_full: no prior %s", key, ", ".join(lacking))
    return priors
