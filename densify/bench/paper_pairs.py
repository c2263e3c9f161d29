# SPDX-License-Identifier: MIT
"""The pairs of clouds that ``densify bench paper`` measures on.

Sets of others are folders of .npz files as FlowNet3D's authors made them (Liu et al., CVPR 2019):
``points1``, ``points2``, ``flow`` and ``valid_mask1`` (FlyingThings3D; camera axes, z forward), or
``pos1``, ``pos2`` and ``gt`` (KITTI without ground; z up).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from densify.config import resolve
from densify.config.errors import InputError
from densify.geometry.types import Bool, Float
from densify.learning.clips import make_clip
from densify.learning.clouds import AboveGround, Sweeps
from densify.learning.samples import sample_of
from densify.readers import open_sequence
from densify.readers.decoded_files import read_arrays

FARTHEST_M = 35.0
_MOST_SWEEPS = 5
_NAMES = (
    ("points1", "points2", "flow", "valid_mask1"),
    ("pos1", "pos2", "gt", ""),
)
_R_FLU_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Turns axes right, down, forward into forward, left, up."""


@dataclass(frozen=True)
class PaperPair:
    """Two clouds and the true flow between them.

    source, target: (n,3), (m,3) metres, z up.
    flow: (n,3) metres.
    moving: (n,), None where the set does not tell.
    sweeps: the input of networks.
    """

    name: str
    source: Float
    target: Float
    flow: Float
    moving: Bool | None
    sweeps: Sweeps


def has_truth(spec: str) -> bool:
    """Return True if a recording has exact truth."""
    return open_sequence(spec).truth is not None


def pair_of_recording(spec: str, key: int) -> PaperPair:
    """Return a sweep and its next one, without ground and the motion of the vehicle.

    Where the recording has no truth, the flow is what this package's engine finds. Raises
    InputError for a key without a next sweep, ComputationError where one cannot be registered.
    """
    sequence = open_sequence(spec)
    teacher, settings = "engine", resolve(None)
    if sequence.truth is not None:
        teacher, settings = "truth", resolve({"register": {"source": "dataset"}})
    clip = make_clip(sequence, key, settings, teacher)
    here = next(i for i, s in enumerate(clip) if not s.origin_m.any())
    if here + 1 == len(clip):
        raise InputError(f"--data {spec}: no sweep after {key}; choose an earlier one")
    sample = sample_of(clip, here, here + 1, _MOST_SWEEPS)
    source, target = (clip[n].points.astype(np.float64) for n in (here, here + 1))
    flow, moving = sample.flow.double().numpy(), sample.moving.numpy()
    return PaperPair(f"{spec}@{key}", source, target, flow, moving, sample.sweeps)


def pairs_of_files(folder: Path, most: int) -> Iterator[PaperPair]:
    """Yield the first ``most`` files of a folder, by name; 0 for all.

    Raises InputError for a folder without any, or a file of another form.
    """
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise InputError(f"{folder}: no .npz files; expected the sets of FlowNet3D's authors")
    for path in paths[: most or None]:
        yield read_pair(path)


def read_pair(path: Path) -> PaperPair:
    """Return the pair of one file, without points farther than 35 m ahead."""
    arrays = read_arrays(path)
    found = next((names for names in _NAMES if all(n in arrays for n in names[:3])), None)
    if found is None:
        raise InputError(
            f"{path}: holds {', '.join(sorted(arrays)) or 'nothing'}, expected points1, points2 "
            f"and flow, or pos1, pos2 and gt"
        )
    source, target, flow = (np.asarray(arrays[name], np.float64) for name in found[:3])
    for name, array in zip(found, (source, target, flow), strict=False):
        if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
            raise InputError(f"{path}: {name}: got shape {array.shape}, expected (N,3) numbers")
    valid = np.asarray(arrays.get(found[3], np.ones(len(source)))).astype(bool).ravel()
    for name, rows in ((found[2], flow), (found[3], valid)):
        if len(rows) != len(source):
            raise InputError(f"{path}: {name}: got {len(rows)} rows, expected {len(source)}")
    if found is _NAMES[0]:
        source, target, flow = (x @ _R_FLU_CAMERA.T for x in (source, target, flow))
    valid &= np.abs(source[:, 0]) < FARTHEST_M
    source, flow = source[valid], flow[valid]
    target = target[np.abs(target[:, 0]) < FARTHEST_M]
    if not (len(source) and len(target)):
        raise InputError(f"{path}: no valid point within {FARTHEST_M:g} m ahead")
    lowest = min(source[:, 2].min(), target[:, 2].min())
    sweeps = [
        AboveGround(np.arange(len(x)), x, (x[:, 2] - lowest).astype(np.float32)).cloud(np.zeros(3))
        for x in (source, target)
    ]
    return PaperPair(path.stem, source, target, flow, None, sweeps)
