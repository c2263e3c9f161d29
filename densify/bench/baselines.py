# SPDX-License-Identifier: MIT
"""Compare simpler maps with ours on real and exact truth: ``densify bench baselines``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from densify.bench.depth import TruthMap
from densify.bench.gate import KEYS, GateKey, Subject
from densify.config import resolve
from densify.geometry.types import Float32
from densify.pipeline.process import Watch
from densify.pipeline.recording import Recording
from densify.pipeline.run import densify
from densify.scores.depth_metrics import DepthErrors, errors_by_part, mean_errors

_FARTHEST_M = 100.0  # of inverted depths
_DIAMOND = np.array(
    [[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]], np.uint8
)
_SINGLE_SWEEP = {"accumulate": {"far_m": 0}}


GROUPS: Mapping[str, tuple[GateKey, ...]] = {
    "KITTI, stereo": tuple(key for key in KEYS if key.truth == "stereo"),
    "PandaSet, second scanner": tuple(key for key in KEYS if key.truth == "scanner"),
    "street, exact": tuple(key for key in KEYS if key.data == "street?seed=301"),
}
"""Name of a truth -> keys that it scores."""


def errors_of_methods(
    keys: Sequence[GateKey], folder: Path | None
) -> dict[str, dict[str, DepthErrors]]:
    """Return method -> part of the pixels (as `errors_by_part`) -> mean errors over the keys."""
    errors: dict[str, dict[str, list[DepthErrors]]] = {}
    for key in keys:
        subject = Subject.of(key, folder, None)
        truth = cast(TruthMap, subject.truth)  # none of these keys is held out
        focal_px = subject.camera.focal_px
        for method, depth_m in _maps(subject).items():
            parts = errors_by_part(
                depth_m,
                truth.depth_m,
                truth.moving,
                focal_px=focal_px,
                baseline_m=truth.baseline_m,
            )
            for part, of_key in parts.items():
                errors.setdefault(method, {}).setdefault(part, []).append(of_key)
    return {
        method: {part: mean_errors(of_keys) for part, of_keys in parts.items()}
        for method, parts in errors.items()
    }


def _maps(subject: Subject) -> dict[str, Float32]:
    """Return name of the method -> its map (H,W) in metres."""
    key, camera = subject.key.key, subject.key.camera
    results = densify(subject.recording, key, ["none", "icp", "flow"], [camera], Watch())
    sweep_m, ours = results["none"].depth[camera].depth_m, results["flow"].depth[camera]
    alone = Recording(subject.recording.sequence, resolve(_SINGLE_SWEEP), 0, [key])
    single = densify(alone, key, ["flow"], [camera], Watch())["flow"].depth[camera]
    return {
        "single sweep": sweep_m,
        "single sweep, filled": single.filled_m,
        "single sweep, IP-Basic": ip_basic(sweep_m),
        "rigid (ICP)": results["icp"].depth[camera].depth_m,
        "densify, measured": ours.depth_m,
        "densify, filled": ours.filled_m,
    }


def ip_basic(sparse_m: Float32) -> Float32:
    """Return a map filled by dilation and closing, (H,W) metres, 0 where nothing is near.

    ``sparse_m`` is (H,W) metres, 0 for none. Source: Ku, Harakeh, Waslander, "In Defense of
    Classical Image Processing: Fast Depth Completion on the CPU", CRV 2018, not extended upwards.
    """
    has_depth = (sparse_m > 0) & (sparse_m < _FARTHEST_M)
    inverted = np.where(has_depth, np.float32(_FARTHEST_M) - sparse_m, np.float32(0))
    inverted = np.asarray(cv2.dilate(inverted, _DIAMOND), np.float32)
    inverted = cv2.morphologyEx(inverted, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    for size in (7, 31):
        dilated = cv2.dilate(inverted, np.ones((size, size), np.uint8))
        inverted = np.where(inverted > 0, inverted, dilated).astype(np.float32)
    blurred = cv2.GaussianBlur(cv2.medianBlur(inverted, 5), (5, 5), 0)
    return np.where(inverted > 0, np.float32(_FARTHEST_M) - blurred, 0).astype(np.float32)
