# SPDX-License-Identifier: MIT
"""The tables of `densify.depth.confidence`: measured on recordings with exact truth, and checked on
others."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from densify.bench.depth import exact_truth
from densify.config import Config
from densify.config.errors import InputError
from densify.depth import confidence as scale
from densify.depth.exposure import key_shots, load_images
from densify.depth.views import HeldOut, Views
from densify.free_space.range_image import RangeImage
from densify.geometry.types import DepthMap, Float, Float32, Int, LidarSequence, Progress
from densify.pipeline.recording import Recording
from densify.readers.window import choose_cameras
from densify.scores.depth_metrics import is_outlier_depth

FITTED = (
    ("street?seed=51", (60,)),
    ("street:crossing?seed=52", (80,)),
    ("street:highway?seed=53", (70,)),
    ("street?seed=54&sensor=hdl32", (60,)),
    ("street:crossing?seed=55&sensor=vlp16", (80,)),
    ("street?seed=56&sensor=os128", (60,)),
    ("street:highway?seed=57&sensor=hdl32", (80,)),
    ("street:static?seed=58", (60,)),
    ("street?seed=71", (60,)),
    ("street:crossing?seed=72", (70,)),
    ("street:highway?seed=73", (60,)),
    ("street?seed=74&sensor=hdl32", (80,)),
    ("street:crossing?seed=75&sensor=hdl32", (60,)),
    ("street?seed=77&sensor=vlp16", (60,)),
)
CHECKED = (
    ("street?seed=41", (70,)),
    ("street:crossing?seed=42", (90,)),
    ("street:highway?seed=43", (60,)),
    ("street?seed=44", (100,)),
    ("street:crossing", (120,)),
    ("street:crossing?seed=32", (120,)),
    ("street?seed=61&sensor=hdl32", (80,)),
    ("street:crossing?seed=62&sensor=vlp16", (80,)),
    ("street?seed=63&sensor=vlp16", (60,)),
    ("street:highway?seed=64&sensor=hdl32", (70,)),
)
"""Recordings and keys, unless others are asked for."""

_STEPS = np.array([0.0, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.8, 0.9])
_TINY = 1e-30
_NUM_ROUNDS = 300  # of expectation maximization
_DIGITS = 4

Asked = Sequence[tuple[LidarSequence, Sequence[int]]]


class WrongPixels(NamedTuple):
    """Pixels with a wrong depth, (B,) each: their group (`densify.depth.confidence.GROUPS`), the
    step of their rank, and by how much the place is contradicted."""

    group: Int
    step: Int
    contradicted: Float


class Evidence(NamedTuple):
    """One map: its pixels ``shown`` and those ``compared`` with the truth, (G,2,R) as
    `densify.depth.confidence.amounts` has them, and those that are ``wrong``."""

    data: str
    key: int
    camera: str
    source: str
    shown: Float
    compared: Float
    wrong: WrongPixels


def bench_confidence(
    fitted: Asked,
    checked: Asked,
    window: int,
    config: Config,
    cameras: Sequence[str] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit the tables to maps of ``fitted``, recordings with the keys to make, and see how far they
    hold on those of ``checked``; with nothing ``fitted``, how far the package's own tables do. The
    rest as `densify.pipeline.run.run`.

    Returns plain numbers: ``maps`` that were fitted on, ``tables``: by group and cause the rank and
    the share that is wrong, and ``reliability`` by recording and truth, where ``fitted`` is all
    that was fitted on together, and ``unseen`` all others against exact truth.

    Raises InputError for what cannot be used, ComputationError where registration went wrong.
    """
    for sequence, _ in fitted:
        if sequence.truth is None:
            raise InputError(f"--fit {sequence.name}: no exact truth; expected a simulated one")
    num, done = sum(len(keys) for _, keys in (*fitted, *checked)), 0
    found: list[list[Evidence]] = []
    for number, (sequence, keys) in enumerate((*fitted, *checked)):
        found.append([])
        for key in keys:
            found[-1] += _evidence(sequence, key, window, config, cameras, number >= len(fitted))
            done += 1
            if progress is not None:
                progress("bench", done, num)
    fit_on = [e for part in found[: len(fitted)] for e in part]
    written = _written(fit_on) if fitted else scale.own_file()
    tables = scale.tables_of(written)
    unseen = [e for part in found[len(fitted) :] for e in part]
    exact = [e for e in unseen if e.source == "truth"]
    together = {"fitted": fit_on, "unseen": exact}
    rows = {name: _reliability(part, tables) for name, part in together.items() if part}
    for data, source in dict.fromkeys((e.data, e.source) for e in unseen):
        part = [e for e in unseen if (e.data, e.source) == (data, source)]
        rows[f"{data}, {source}"] = _reliability(part, tables)
    return {"maps": written["maps"], "tables": written["tables"], "reliability": rows}


def _written(fit_on: Sequence[Evidence]) -> dict[str, Any]:
    """Tables fitted to these maps, as ``confidence.json`` has them."""
    tables = {
        group: {cause: _knots(share) for cause, share in zip(scale.CAUSES, shares, strict=True)}
        for group, shares in zip(scale.GROUPS, fit(fit_on), strict=True)
    }
    maps = [{"data": e.data, "key": e.key, "camera": e.camera} for e in fit_on]
    return {"maps": maps, "tables": tables}


def _evidence(
    sequence: LidarSequence,
    key: int,
    window: int,
    config: Config,
    cameras: Sequence[str] | None,
    held_out: bool,
) -> Iterator[Evidence]:
    """The maps of a key against exact truth, where there is some, and if asked for those made
    without the key sweep against its own returns."""
    recording = Recording(sequence, config, window, [key], looks_around=True)
    shots = key_shots(sequence, choose_cameras(sequence, cameras), key, config.project)
    stretch = recording.window(key)
    images = load_images(sequence, shots)
    views = Views.of(sequence, stretch, key, RangeImage.of(stretch[key]), shots, images, config)
    cloud = recording.moment(key, all_sweeps=True, engine="").cloud
    seen, standing = views.see(cloud), recording.standing(key)
    if standing is not None:
        seen = seen.joined(views.far(*standing, stretch, standing_only=True))
    truth = exact_truth(sequence, stretch[key].sweep, key, cameras, config)
    for name, maps in views.depth(seen).items():
        if name in truth:
            yield _counted(sequence, key, maps, "truth", truth[name].depth_m)
    if held_out:
        out = HeldOut.of(views, cloud)
        for name, maps in out.depth(seen, visible=True).items():
            yield _counted(sequence, key, maps, "key held out", out.key_alone[name].depth_m)


def _counted(
    sequence: LidarSequence, key: int, maps: DepthMap, source: str, truth_m: Float32
) -> Evidence:
    if maps.ranked is None:
        raise InputError("project.visibility=false: its confidence is not calibrated")
    focal_px = sequence.cameras[maps.camera].focal_px
    shown = maps.filled_m > 0
    compared = shown & (truth_m > 0)
    bad = compared.copy()
    bad[compared] = is_outlier_depth(maps.filled_m[compared], truth_m[compared], focal_px)
    wrong = WrongPixels(
        maps.ranked.group[bad].astype(np.int64),
        scale.steps_of(maps.ranked.rank[bad]),
        maps.ranked.contradicted[bad].astype(np.float64),
    )
    all_shown, all_compared = (scale.amounts(maps.ranked, part) for part in (shown, compared))
    return Evidence(sequence.name, key, maps.camera, source, all_shown, all_compared, wrong)


def fit(evidence: Sequence[Evidence]) -> Float:
    """(G,2,R) share that is wrong by group, cause and step of the rank.

    The tables under which the wrong pixels are most likely (expectation maximization: which cause
    a wrong pixel is owed to is not known), each made to fall with the rank
    (`densify.depth.confidence.falling`). Every map counts alike, so that none decides alone.
    """
    weights = [1 / max(e.compared[:, 0].sum(), 1) for e in evidence]
    pixels: Float = np.sum([w * e.compared for w, e in zip(weights, evidence, strict=True)], axis=0)
    group, step, contradicted = (
        np.concatenate(c) for c in zip(*(e.wrong for e in evidence), strict=True)
    )
    weight = np.repeat(weights, [len(e.wrong.group) for e in evidence])
    causes = np.stack([np.ones_like(contradicted), contradicted])
    tables = []
    for number, num in enumerate(pixels):
        mine = group == number
        tables.append(_fitted(num, step[mine], causes[:, mine], weight[mine]))
    return np.array(tables)


def _fitted(num: Float, step: Int, causes: Float, weight: Float) -> Float:
    """(2,R) shares by cause. num: (2,R) pixels, and how much they are contradicted. step, weight:
    (B,) of those that are wrong. causes: (2,B) what each cause's share is multiplied by there."""
    shares = np.repeat(
        weight.sum() / np.maximum(num.sum(axis=1), _TINY)[:, None], scale.NUM_RANKS, 1
    )
    for _ in range(_NUM_ROUNDS):
        owed = shares[:, step] * causes
        owed *= weight / np.maximum(owed[0] + owed[1], _TINY)
        shares = np.array(
            [
                scale.falling(n, np.bincount(step, part, scale.NUM_RANKS).astype(np.float64))
                for n, part in zip(num, owed, strict=True)
            ]
        )
    return shares


def _knots(shares: Float) -> list[list[float]]:
    """(R,) -> rank and share wherever the curve bends."""
    bends = np.abs(np.diff(shares, 2)) > 1e-12
    kept = np.concatenate([[True], bends, [True]])
    ranks = (np.flatnonzero(kept) + 0.5) / scale.NUM_RANKS
    digits = [float(f"{share:.{_DIGITS}g}") for share in shares[kept]]
    return [[round(float(r), 4), s] for r, s in zip(ranks, digits, strict=True)]


def _reliability(evidence: Sequence[Evidence], tables: Float) -> list[dict[str, Any]]:
    """As `densify.depth.confidence.reliability`, in wider steps where hardly anything is wrong."""
    sums = np.zeros((3, len(_STEPS)))
    for e in evidence:
        measured, filled = scale.curves(e.shown, tables)
        log = np.where(
            (np.arange(len(scale.GROUPS)) < scale.NUM_MEASURED)[:, None], measured, filled
        )
        step = np.searchsorted(_STEPS, np.clip(-log / scale.DECADES, 0, 1), side="right") - 1
        num, bad = e.compared[:, 0], np.zeros(log.shape)
        np.add.at(bad, (e.wrong.group, e.wrong.step), 1)
        for total, part in zip(sums, (num, num * 10.0**log, bad), strict=True):
            total += np.bincount(step.ravel(), part.ravel(), len(_STEPS))
    return [
        {
            "confidence": float(least),
            "num_compared": round(num),
            "expected": expected / num,
            "outliers": bad / num,
        }
        for least, num, expected, bad in zip(_STEPS, *sums.tolist(), strict=True)
        if num > 0
    ]
