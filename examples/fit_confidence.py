# SPDX-License-Identifier: MIT
"""Fits the tables of confidence to maps of simulated streets, checks them on others, and writes a
file such as densify/depth/confidence.json.

python examples/fit_confidence.py OUT.json [--fit SPEC@KEY …] [--check SPEC@KEY …] [--window W]
"""

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

import densify
from densify.config import resolve
from densify.depth import confidence as scale
from densify.scores.depth_metrics import is_outlier_depth

FITTED = """
    street?seed=51@60 street:crossing?seed=52@80 street:highway?seed=53@70 street:static?seed=58@60
    street?seed=54&sensor=hdl32@60 street:crossing?seed=55&sensor=vlp16@80 street?seed=71@60
    street?seed=56&sensor=os128@60 street:highway?seed=57&sensor=hdl32@80 street:crossing?seed=72@70
    street:highway?seed=73@60 street?seed=74&sensor=hdl32@80 street?seed=77&sensor=vlp16@60
    street:crossing?seed=75&sensor=hdl32@60
"""
CHECKED = """
    street?seed=41@70 street:crossing?seed=42@90 street:highway?seed=43@60 street?seed=44@100
    street:crossing@120 street:crossing?seed=32@120 street?seed=61&sensor=hdl32@80
    street:crossing?seed=62&sensor=vlp16@80 street?seed=63&sensor=vlp16@60
    street:highway?seed=64&sensor=hdl32@70
"""
STEPS = np.array([0.0, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.8, 0.9])


class Evidence(NamedTuple):
    """The (G,R) numbers of pixels of one map, see `num_pixels` in densify.depth.confidence.

    shown: all pixels. compared: those with a truth. outliers: the outliers among the latter.
    """

    where: dict
    shown: np.ndarray
    compared: np.ndarray
    outliers: np.ndarray


def evidence(text, window, changes):
    """Yield the evidence of each camera's map of ``SPEC@KEY``, against exact truth."""
    spec, _, key = text.rpartition("@")
    print(f"making {text}", file=sys.stderr, flush=True)
    sequence, config = densify.open_sequence(spec), resolve(None, changes)
    if sequence.truth is None:
        raise SystemExit(f"{spec}: no exact truth; expected a simulated recording")
    result = densify.run(sequence, int(key), window, config=config)
    for camera, maps in result.depth.items():
        known_m, found = result.truth_m[camera], maps.ranked
        shown = maps.filled_m > 0
        compared = shown & (known_m > 0)
        bad = compared.copy()
        focal_px = sequence.cameras[maps.camera].focal_px
        bad[compared] = is_outlier_depth(maps.filled_m[compared], known_m[compared], focal_px)
        yield Evidence(
            {"data": sequence.name, "key": int(key), "camera": camera},
            *(scale.num_pixels(found, part) for part in (shown, compared, bad)),
        )


def fit(maps):
    """Return the (G,R) share of outliers by group and step of the rank, made to fall with the rank.

    Every map counts alike.
    """
    weights = [1 / max(e.compared.sum(), 1) for e in maps]
    num, bad = (
        sum(w * part for w, part in zip(weights, parts, strict=True))
        for parts in ([e.compared for e in maps], [e.outliers for e in maps])
    )
    return np.array([scale.falling(n, b) for n, b in zip(num, bad, strict=True)])


def knots(shares):
    """Return rank and share wherever the (R,) curve bends."""
    kept = np.concatenate([[True], np.abs(np.diff(shares, 2)) > 1e-12, [True]])
    ranks = (np.flatnonzero(kept) + 0.5) / scale.NUM_RANKS
    return [
        [round(float(r), 4), float(f"{s:.4g}")] for r, s in zip(ranks, shares[kept], strict=True)
    ]


def check(maps, tables):
    """Print, by confidence, the pixels and the expected and the true share of outliers."""
    sums = np.zeros((3, len(STEPS)))
    is_measured = (np.arange(len(scale.GROUPS)) < scale.NUM_MEASURED)[:, None]
    for e in maps:
        log = np.where(is_measured, *scale.curves(e.shown, tables)[:, None])
        step = np.searchsorted(STEPS, np.clip(-log / scale.DECADES, 0, 1), side="right") - 1
        parts = e.compared, e.compared * 10.0**log, e.outliers
        for total, part in zip(sums, parts, strict=True):
            total += np.bincount(step.ravel(), part.ravel(), len(STEPS))
    print("confidence from      pixels  expected  outliers")
    for least, num, expected, bad in zip(STEPS, *sums, strict=True):
        if num:
            print(f"{least:15.2f} {num:11,.0f} {expected / num:9.3%} {bad / num:9.3%}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--fit", nargs="+", default=FITTED.split())
    parser.add_argument("--check", nargs="+", default=CHECKED.split())
    parser.add_argument("--window", type=int, default=5)
    parser.add_argument("--set", nargs="+", default=[], dest="changes")
    given = parser.parse_args()
    fitted, checked = (
        [e for text in texts for e in evidence(text, given.window, given.changes)]
        for texts in (given.fit, given.check)
    )
    tables = {g: knots(share) for g, share in zip(scale.GROUPS, fit(fitted), strict=True)}
    written = {"densify": densify.__version__, "maps": [e.where for e in fitted], "tables": tables}
    given.out.write_text(json.dumps(written, indent=2) + "\n")
    for title, maps in (("fitted to:", fitted), ("others:", checked)):
        print(title)
        check(maps, scale.tables_of(written))


if __name__ == "__main__":
    main()
