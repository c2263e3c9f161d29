# SPDX-License-Identifier: MIT
"""Fits the weights that tell moving tracks from static ones to the tracks that the search tries on
simulated streets, checks them on others, and writes a file such as
densify/flow/tracking/likelihood.json.

python examples/fit_tracks.py OUT.json [--fit SPEC@KEY …] [--check SPEC@KEY …] [--window W]
"""

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

import densify
from densify.config import resolve
from densify.flow.engines import Scene
from densify.flow.tracking.likelihood import fitted_weights
from densify.flow.tracking.tracks import find_tracks
from densify.free_space.ground import ground
from densify.geometry.types import Stretch
from densify.pipeline.recording import Recording

FITTED = """
    street:crossing?seed=301&sensor=vlp16@60 street:static?seed=302&sensor=hdl32@60
    street?seed=303&sensor=vlp16@100 street:highway?seed=305&sensor=vlp16@60
    street:static?seed=306&sensor=vlp16@90 street:crossing?seed=307&sensor=rosette@50
    street?seed=308&sensor=dual32@80 street:crossing?seed=309&sensor=hdl32@60
    street?seed=310&sensor=vlp16&hz=20@120 street:highway?seed=311&sensor=hdl32@50
    street:static?seed=312@60 street:static?seed=313&sensor=rosette@60 street?seed=314@50
    street:crossing?seed=315&hz=5&sensor=vlp16@40 street:static?seed=316&sensor=vlp16&hz=20@150
    street:crossing?seed=317@60 street:static?seed=318&sensor=dual32@60 street:highway?seed=319@100
    street?seed=320&sensor=hdl32@110 street:static?seed=321&sensor=hdl32&hz=5@50
    street:highway?seed=322&sensor=dual32@60
"""
CHECKED = "street:crossing?seed=26&sensor=vlp16@90 street?seed=25&sensor=hdl32@70"
PRICE = 10.0  # of a static track that is taken to move, in moving tracks that are missed
STIFFNESS = 1.0  # of the weights, in units of the terms' spread
SURELY = 0.9  # of a track's points, else it is of both kinds and tells nothing
WRONG_M, WRONG = 0.05, 0.25  # mean error from which a motion is wrong: and by the way to go


class Tracks(NamedTuple):
    """The K tracks that were tried on a street. terms: (K,T). moves: (K,) bool, of its points.
    right: (K,) bool, and so does it."""

    street: str
    terms: np.ndarray
    moves: np.ndarray
    right: np.ndarray


def tried(text, window):
    """Return the tracks of the window of ``SPEC@KEY``, and of shorter stretches of it."""
    spec, _, key = text.rpartition("@")
    print(f"making {text}", file=sys.stderr, flush=True)
    sequence = densify.open_sequence(spec)
    if sequence.truth is None:
        raise SystemExit(f"{spec}: no exact truth; expected a simulated recording")
    recording = Recording(sequence, resolve(None), window, [int(key)], looks_around=True)
    stretch = recording.searched(int(key))
    heights, num = ground(stretch), len(stretch.sweeps)
    parts = {(0, num), (num // 4, num - num // 4), (0, max(3, num // 5)), (num - 3, num)}
    found = [
        track
        for begin, end in sorted(parts)
        for track in tried_in(Stretch(stretch.sweeps[begin:end]), heights, sequence.truth)
    ]
    terms = np.array([[evidence.terms()[name] for name in names()] for evidence, *_ in found])
    share, error_m, way_m = np.array([labels for _, *labels in found]).reshape(-1, 3).T
    sure = np.abs(share - 0.5) >= SURELY - 0.5
    moves, right = share > 0.5, error_m <= WRONG_M + WRONG * way_m
    return Tracks(text, terms.reshape(-1, len(names()))[sure], moves[sure], (moves & right)[sure])


def tried_in(stretch, heights, truth):
    """Return the evidence of each track of a stretch, the share of its points that move, and their
    mean error and way (m) to the next sweep."""
    scene, found = Scene(stretch, heights), []
    obstacles = scene.obstacles
    moving = [truth.sweep(s.frame).moving[s.sweep.row] for s in stretch.sweeps]

    steps = list(zip(stretch.sweeps, stretch.frames[1:], strict=False))
    true = [truth.displacement(s.frame, target)[s.sweep.row] for s, target in steps]
    time_s = scene.space.clock.time_s

    def record(track, evidence):
        on, off_m, way_m = [], [], []
        for i, rows in track.claimed.items():
            c = obstacles[i]
            on.append(moving[i][c.row[rows]])
            if i < len(true):
                own, at = track.undo(c.points[rows], c.time_s[rows]), true[i][c.row[rows]]
                step = track.place(own, time_s[i + 1]) - track.place(own, time_s[i])
                off = step @ stretch.sweeps[i].T_world_lidar[:3, :3] - at
                off_m.append(np.linalg.norm(off[:, :2], axis=1))
                way_m.append(np.linalg.norm(at, axis=1))
        means = (np.concatenate(values).mean() for values in (on, off_m, way_m))
        found.append((evidence, *means))

    find_tracks(obstacles, scene.space, heights, record=record)
    return found


def names():
    """Return the names of the terms."""
    return [name for name in fitted_weights() if name != "price"]


def fit(streets):
    """Return (T+1,) the weights and the price under which the tracks are most likely (logistic
    regression)."""
    terms = np.concatenate([s.terms for s in streets])
    moves, right = (np.concatenate([getattr(s, k) for s in streets]) for k in ("moves", "right"))
    cost = np.where(moves, 1.0, PRICE)
    mean, spread = terms.mean(axis=0), terms.std(axis=0) + 1e-9
    x = np.column_stack([(terms - mean) / spread, np.ones(len(terms))])

    def loss(w):
        z, stiff = x @ w, STIFFNESS * np.append(w[:-1], 0)
        wrong = cost * (expit(z) - right)
        value = (cost * np.logaddexp(0, np.where(right, -z, z))).sum()
        return value + stiff @ w / 2, x.T @ wrong + stiff

    w = minimize(loss, np.zeros(x.shape[1]), jac=True, method="BFGS").x
    weights = w[:-1] / spread
    return np.append(weights, weights @ mean - w[-1])


def check(streets, weights):
    """Print how many tracks of each street are taken to move. weights: of each street."""
    print("moving  taken  static  taken")
    for (street, terms, moves, right), w in zip(streets, weights, strict=True):
        taken = terms @ w[:-1] > w[-1]
        num, num_static = right.sum(), (~moves).sum()
        print(f"{num:6} {taken[right].sum():6} {num_static:7} {taken[~moves].sum():6}  {street}")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--fit", nargs="+", default=FITTED.split())
    parser.add_argument("--check", nargs="+", default=CHECKED.split())
    parser.add_argument("--window", type=int, default=5)
    given = parser.parse_args()
    fitted, checked = (
        [tried(text, given.window) for text in texts] for texts in (given.fit, given.check)
    )
    weights = fit(fitted)
    without = np.array([fit([s for s in fitted if s is not one]) for one in fitted])
    print("by the weights that all other streets give:")
    check(fitted, without)
    print("by the weights that are written:")
    check(checked, [weights] * len(checked))
    # Jackknife: tracks of one street are no independent samples.
    std = np.sqrt((len(without) - 1) * without.var(axis=0))
    written = {"densify": densify.__version__, "streets": given.fit}
    for title, values in (("weights", weights), ("std", std)):
        rounded = (float(f"{value:.4g}") for value in values)
        written[title] = dict(zip([*names(), "price"], rounded, strict=True))
    given.out.write_text(json.dumps(written, indent=2) + "\n")


if __name__ == "__main__":
    main()
