# SPDX-License-Identifier: MIT
"""A result completed with the depth images that the user brings."""

from __future__ import annotations

import copy
import logging
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from densify.config.errors import InputError
from densify.depth.exposure import Shot
from densify.geometry.types import Bool, Camera, Float32, Prior, Result
from densify.readers.prior_files import PriorFiles
from densify.scores import depth_metrics

_log = logging.getLogger("densify")


def key_priors(files: PriorFiles, shots: Mapping[str, Shot], key: int) -> dict[str, Prior]:
    """The priors of a key's maps, by their names: those of the images they show, or of the key's
    number where a map shows none. Raises InputError if there is none at all."""
    found, lacking = {}, []
    for name, shot in shots.items():
        number = key if shot.number is None else shot.number
        prior = files.prior(shot.camera, number)
        if prior is not None:
            found[name] = prior
        else:
            lacking.append(f"{shot.camera.name} {number} ({files.said_of(shot.camera.name)})")
    if lacking and not found:
        raise InputError(f"--prior {files.place}: key {key}: no depth image {', '.join(lacking)}")
    if lacking:
        _log.warning("key %d: no depth_full: no prior %s", key, ", ".join(lacking))
    return found


def completed(
    result: Result,
    priors: Mapping[str, Prior],
    truth: Mapping[str, tuple[Float32, Bool]],
    cameras: Mapping[str, Camera],
    kind: str,
) -> Result:
    """The result with ``full`` and its scores added; a prior that does not fit gets a warning.

    priors, truth: by the maps' names; truth: depth and what moves, (H,W) each, where known.
    """
    from densify.depth.prior import MAX_WRONG, complete  # SciPy's solvers, for this alone

    full = {name: complete(result.depth[name], p, kind) for name, p in priors.items()}
    metrics = copy.deepcopy(dict(result.metrics))
    for name, maps in full.items():
        if not maps.fit.used:
            _log.warning(
                "key %d: the prior %s is not used, depth_full is as depth_filled: after the best "
                "fit %.0f %% of measured pixels are off by more than 25 %%, expected at most "
                "%.0f %%",
                result.key,
                maps.source,
                100 * maps.fit.wrong,
                100 * MAX_WRONG,
            )
        alone_m = np.where(maps.from_prior, maps.depth_m, np.float32(0))
        for product, depth_m in (("full", maps.depth_m), ("prior", alone_m)):
            metrics["density"][name][product] = depth_metrics.image_density(depth_m)
            if name in truth:
                metrics["depth"][name][product] = depth_metrics.scores_by_motion(
                    depth_m, *truth[name], cameras[result.depth[name].camera]
                )
    return replace(result, full=full, metrics=metrics)
