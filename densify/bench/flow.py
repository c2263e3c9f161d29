# SPDX-License-Identifier: MIT
"""Compare methods of scene flow on the same window of sweeps: ``densify bench flow``.

Errors are those of the flow to the neighbouring sweep towards the key sweep, pooled over the points
above the ground. Seconds per pair of sweeps cover ground estimation, this flow and the flow to the
key sweep. ``densify bench readme`` makes the tables of docs/flow-results.md again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.config import Config, as_mapping, resolve
from densify.config.errors import InputError, did_you_mean
from densify.flow.engines import Scene, estimate_motion
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.free_space.range_image import RangeImage
from densify.geometry import poses
from densify.geometry.types import (
    Bool,
    Float,
    FlowField,
    LidarSequence,
    Motion,
    Progress,
    Stretch,
    Truth,
)
from densify.outputs.folders import plain
from densify.pipeline.accumulate import accumulate
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.readers.flow_files import LabelledFlow, read_labelled_flow
from densify.scores.metrics import (
    CLASSES,
    challenge_scores,
    end_point_error,
    end_point_errors,
    ghost_rate,
    mean_of,
    window_pose_errors,
)

_MIN_RETURNS = 30
_LEAST_MOTION_M = 0.5
_PAPER = ("flow.engine=paper", "objective.static_prior=false")
METHODS: Mapping[str, tuple[str, ...] | None] = {
    "ours": (),
    "ours-pair": ("flow.engine=pairs",),
    "paper": (*_PAPER, "objective.solver=pcg"),
    "paper-adam": (*_PAPER, "objective.solver=adam"),
    "rigid": None,
}
"""Name of a method -> changes of the configuration. None: all points are static."""
DEFAULT_METHODS = tuple(name for name in METHODS if name != "paper-adam")


def bench_flow(
    sequence: LidarSequence,
    key: int,
    window: int,
    config: Config,
    methods: Sequence[str] = DEFAULT_METHODS,
    progress: Progress | None = None,
    truth: Path | None = None,
) -> dict[str, Any]:
    """Run and measure methods of scene flow on the window of one key sweep.

    Args:
        window: Number of sweeps on each side of the key sweep.
        methods: Names in `METHODS`. ``ours`` is the configured engine.
        truth: Folder of true flow (`densify.readers.flow_files`), which scores only the sweeps
            before the key sweep. None for the exact ground truth of the recording.

    Returns:
        ``data``, ``key``, ``frames``, ``num_pairs``, and ``methods``: name -> ``seconds_per_pair``
            and the scores ``step``, ``challenge``, ``window`` of `Scorer`. Numbers are plain, None
            if unknown.
    """
    unknown = [method for method in methods if method not in METHODS]
    if unknown or not methods:
        raise InputError(
            f"--methods: got {unknown[0] if unknown else 'none'}, expected {', '.join(METHODS)}"
        )
    scorer = Scorer.of(sequence, key, window, config, truth)
    if not scorer.sources:
        raise InputError(f"--key {key}: no pair to score in {sequence.name}; choose another key")
    frames, rows = scorer.stretch.frames, {}
    chosen = [name for name in METHODS if name in methods]
    for done, method in enumerate(chosen):
        if progress is not None:
            progress(method, done, len(chosen))
        steps, to_key, seconds = _estimate_flows(method, scorer, config)
        scores = {
            "seconds_per_pair": seconds / (len(frames) - 1),
            "step": scorer.step_scores(steps),
            "challenge": scorer.pooled_challenge_scores(steps),
            "window": scorer.window_scores(to_key),
        }
        rows[method] = plain(scores)
    facts = {"data": sequence.name, "key": key, "frames": list(frames)}
    return {**facts, "num_pairs": len(scorer.sources), "methods": rows}


class SweepTruth(NamedTuple):
    """True scene flow (m, without ego-motion) of a sweep, lidar frame at its reference time."""

    step: Float  # (N,3) flow to the neighbouring sweep towards the key sweep
    to_key: Float  # (N,3) flow to the key sweep
    moving: Bool  # (N,) bool, True for points that move at the reference time
    foreground: Bool  # (N,) bool, True for points of objects, moving or not
    # (N,) bool, True for moving points that travel at least 0.5 m over the window and belong to an
    # object with 30 returns or more
    certain: Bool

    @staticmethod
    def of(truth: Truth, stretch: Stretch, frame: int, key: int) -> SweepTruth:
        """Return the exact ground truth of the sweep with the number ``frame`` in a window."""
        rows, frames = stretch[frame].sweep.row, stretch.frames
        targets = (towards(key, frame, frames), key, frames[0], frames[-1])
        step, to_key, to_first, to_last = (
            truth.displacement(frame, target)[rows] for target in targets
        )
        sweep_truth = truth.sweep(frame)
        moving, instance = sweep_truth.moving[rows], sweep_truth.instance[rows]
        # One more bin than objects: instance -1, no object, reads the last, empty bin.
        num_returns = np.bincount(instance[instance >= 0], minlength=instance.max(initial=-1) + 2)
        is_large = (instance >= 0) & (num_returns[instance] >= _MIN_RETURNS)
        travels = np.linalg.norm(to_last - to_first, axis=1) >= _LEAST_MOTION_M
        return SweepTruth(step, to_key, moving, instance >= 0, moving & is_large & travels)

    def as_label(self) -> LabelledFlow:
        """Return the flow to the neighbouring sweep as a label, of objects of unknown kind."""
        classes = np.where(self.foreground, CLASSES.index("OBJECT"), 0).astype(np.uint8)
        return LabelledFlow(self.step, classes, np.ones(len(classes), bool))


@dataclass(frozen=True)
class Scorer:
    """Scorer of methods on a window, mostly by points above the ground, which no method moves."""

    stretch: Stretch  # registered sweeps of the window
    key: int  # frame number of the key sweep
    around: Stretch  # sweeps from which the configured method estimates motion
    above: Mapping[int, Bool]  # frame number -> (N,) mask of points above the ground
    sources: tuple[int, ...]  # frame numbers of the sweeps whose flow to a neighbour is scored
    # Frame number -> exact ground truth, None for a real recording
    truths: Mapping[int, SweepTruth] | None
    # Frame number -> labelled flow to the neighbour, {} without ground truth
    labels: Mapping[int, LabelledFlow]

    @staticmethod
    def of(
        sequence: LidarSequence, key: int, size: int, config: Config, folder: Path | None
    ) -> Scorer:
        """Register the window of a key sweep, ``size`` sweeps on each side, and read its truth.

        ``folder`` has files of true flow (`densify.readers.flow_files`). None takes the exact truth
        of a simulated recording, and no truth for a real one.
        """
        recording = Recording(sequence, config, size, [key], looks_around=True)
        stretch = recording.window(key)
        heights, frames = ground(stretch), stretch.frames
        above = {}
        for registered in stretch.sweeps:
            points = poses.transform(registered.T_world_lidar, registered.sweep.points)
            above[registered.frame] = heights.above(points) >= ABOVE_GROUND_M
        # Files of true flow hold the flow to the next sweep: towards the key only before it.
        sources = tuple(
            frame for frame in frames if (frame < key if folder is not None else frame != key)
        )
        truths, labels = None, {}
        if sequence.truth is not None:
            truths = {f: SweepTruth.of(sequence.truth, stretch, f, key) for f in frames}
        if folder is not None:
            labels = {f: read_labelled_flow(folder, sequence.name, stretch, f) for f in sources}
        elif truths is not None:
            labels = {f: truths[f].as_label() for f in sources}
        return Scorer(stretch, key, recording.searched_stretch(key), above, sources, truths, labels)

    def pooled_challenge_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any] | None:
        """Return `challenge_scores` of frame -> flow towards the key sweep; None without truth."""
        if not self.labels:
            return None
        columns = []
        for frame, label in self.labels.items():
            points = self.stretch[frame].sweep.points
            values = (points, steps[frame].displacement, label.flow, label.classes)
            columns.append([x[self.above[frame] & label.valid] for x in values])
        return challenge_scores(*map(np.concatenate, zip(*columns, strict=True)))

    def step_scores(self, steps: Mapping[int, FlowField]) -> dict[str, Any]:
        """Return the scores of each sweep's flow to its neighbour towards the key, pooled.

        ``found`` is the share of ``certain`` moving points that are called moving,
        ``falsely_moving`` that of static points, ground included. End-point errors in metres are
        ``movers_m`` of moving points and ``found_movers_m`` of those called moving. Without ground
        truth, ``called_moving`` is the share of all points called moving.
        """
        truths = self.truths
        if truths is None:
            moving = np.concatenate([steps[f].moving for f in self.sources])
            return {"called_moving": float(moving.mean())}
        flow, called = (self._above(steps, name) for name in ("displacement", "moving"))
        true, moving, objects, certain = (
            self._above(truths, name) for name in ("step", "moving", "foreground", "certain")
        )
        static = np.concatenate([steps[f].moving[~truths[f].moving] for f in self.sources])
        return {
            "num_movers": int(moving.sum()),
            "movers_m": end_point_error(flow, true, objects & moving),
            "found_movers_m": end_point_error(flow, true, moving & called),
            "static_objects_m": end_point_error(flow, true, objects & ~moving),
            "background_m": end_point_error(flow, true, ~objects & ~moving),
            "found": mean_of(called[certain]),
            "falsely_moving": mean_of(static),
        }

    def window_scores(self, to_key: Mapping[int, FlowField]) -> dict[str, Any]:
        """Return the ghost rate of the flow to the key (``to_key``), and errors if truth is known.

        Errors are metres, above the ground, by number of sweeps to the key: ``movers_m_by_hops`` of
        moving points, ``found_movers_m_by_hops`` of those called moving.
        """
        stretch, key, frames = self.stretch, self.key, self.stretch.frames
        cloud = accumulate(stretch, [to_key[f] for f in frames], key, drop_lost=True)
        scores: dict[str, Any] = {"ghost_rate": ghost_rate(cloud, RangeImage.of(stretch[key]), key)}
        if self.truths is None:
            return scores
        errors_m: dict[str, dict[str, list[Float]]] = {"movers": {}, "found_movers": {}}
        for frame, truth in self.truths.items():
            if frame != key:
                flow, hops = to_key[frame], str(abs(frames.index(key) - frames.index(frame)))
                followed = truth.moving & self.above[frame] & ~flow.lost
                error_m = end_point_errors(flow.displacement, truth.to_key)
                for name, rows in (("movers", followed), ("found_movers", followed & flow.moving)):
                    errors_m[name].setdefault(hops, []).append(error_m[rows])
        for name, by_hops in errors_m.items():
            means = {hops: mean_of(np.concatenate(by_hops[hops])) for hops in sorted(by_hops)}
            scores[f"{name}_m_by_hops"] = means
        return scores

    def _above(self, of_frame: Mapping[int, Any], name: str) -> Any:
        """Return a pooled column of frame -> truth or flow, of the points above the ground."""
        columns = (getattr(of_frame[f], name)[self.above[f]] for f in self.sources)
        return np.concatenate([*columns])


def towards(key: int, frame: int, frames: Sequence[int]) -> int:
    """Return the frame number next to ``frame`` towards the key sweep, the key's own at the key."""
    row = frames.index(frame)
    return frames[row + int(np.sign(frames.index(key) - row))]


def _estimate_flows(
    method: str, scorer: Scorer, config: Config
) -> tuple[dict[int, FlowField], dict[int, FlowField], float]:
    """Return frame -> flow to the neighbour towards the key, frame -> flow to the key; seconds."""
    stretch, key = scorer.stretch, scorer.key
    changes, frames = METHODS[method], stretch.frames
    if changes is None:
        still = {f: FlowField.zero(len(stretch[f].sweep)) for f in frames}
        return still, still, 0.0
    config = resolve(as_mapping(config), changes)
    if method == "ours":  # compile before the clock starts, by three sweeps around the key
        begin = max(0, frames.index(key) - 1)
        _motion(Stretch(stretch.sweeps[begin : begin + 3]), config)
    start = time.perf_counter()
    motion = _motion(scorer.around if method == "ours" else stretch, config, frames)
    steps = {f: motion.flow(f, towards(key, f, frames)) for f in frames if f != key}
    to_key = {f: motion.flow(f, key) for f in frames}
    return steps, to_key, time.perf_counter() - start


def _motion(stretch: Stretch, config: Config, asked: Sequence[int] | None = None) -> Motion:
    """Estimate the motion of a stretch, for the asked frame numbers, None for all."""
    return estimate_motion(Scene(stretch, ground(stretch), asked=asked), config)


# The tables of docs/flow-results.md


class KeySweep(NamedTuple):
    """A recording and the key sweep that a row of a table is about."""

    data: str  # specification of the recording
    key: int  # frame number
    window: int = 5  # number of sweeps on each side of the key sweep

    def __str__(self) -> str:
        return f"`{self.data}`, key {self.key}"


def _key_sweeps(text: str) -> tuple[KeySweep, ...]:
    """Return the key sweeps in a text of ``SPEC@KEY`` words, where KEY is a frame number."""
    words = [word.rpartition("@") for word in text.split()]
    return tuple(KeySweep(spec, int(key)) for spec, _, key in words)


_FLOW = _key_sweeps("""
    street?seed=21@70 street:crossing?seed=22@90 street:highway?seed=23@110
    street:static?seed=24@60 street?seed=25&sensor=hdl32@70
    street:crossing?seed=26&sensor=vlp16@90 street?seed=27&sensor=dual32@60
    street:highway?seed=28&sensor=hdl32@70 street:crossing?seed=60&sensor=hdl32@80
    street?seed=63&sensor=hdl32@80 street:highway?seed=29&sensor=vlp16@70
    street?seed=59&sensor=vlp16@80 street:crossing?seed=64&sensor=vlp16@80
    street?seed=421&sensor=rosette@70 street:crossing?seed=422&sensor=rosette@70
""")
_REGISTERED = _key_sweeps("""
    street@120 street:crossing@120 street:highway@120 street?seed=59@80
    street:highway?seed=30&sensor=dual32@70 street:highway?seed=28&sensor=hdl32@70
    street?seed=63&sensor=hdl32@80 street:highway?seed=29&sensor=vlp16@70
    street?seed=59&sensor=vlp16@80 street:crossing?seed=304&sensor=rosette@90
""")


class _Table(NamedTuple):
    """A table of results. ``row`` returns the cells of a scene."""

    about: str
    titles: str
    scenes: tuple[KeySweep, ...]
    row: Callable[[KeySweep], Sequence[str]]


def tables(names: Sequence[str], progress: Progress | None = None) -> Iterator[str]:
    """Measure tables of `TABLES`, by names or all, and yield each line of their Markdown."""
    for name in names:
        if name not in TABLES:
            hint = did_you_mean(name, TABLES)
            raise InputError(f"bench readme {name}: {hint}expected of {', '.join(TABLES)}")
    chosen = [TABLES[name] for name in names or TABLES]
    num_scenes = sum(len(table.scenes) for table in chosen)
    done = 0
    for number, table in enumerate(chosen):
        yield "\n" * (number > 0) + f"{table.about}\n"
        yield f"| | {table.titles} |"
        yield "| --- " * (table.titles.count("|") + 2) + "|"
        for scene in table.scenes:
            yield f"| {' | '.join(table.row(scene))} |"
            done += 1
            if progress is not None:
                progress("bench", done, num_scenes)


def _times_100(value: float | None, digits: int, unit: str) -> str:
    """Return 100 times a value with its unit, a dash for None."""
    return "–" if value is None else f"{100 * value:.{digits}f}{unit}"


def _row_of_flow(scene: KeySweep) -> list[str]:
    """Return recall, errors, false positives and ghosts of scene flow on one window."""
    sequence, key = open_sequence(scene.data), scene.key
    scores = bench_flow(sequence, key, scene.window, resolve(None), ["ours"])["methods"]["ours"]
    step, window, hops = scores["step"], scores["window"], str(scene.window)
    errors_m, called_errors_m = window["movers_m_by_hops"], window["found_movers_m_by_hops"]
    return [
        str(scene),
        _times_100(step["found"], 1, " %"),
        _errors(step["movers_m"], step["found_movers_m"]),
        _errors(errors_m.get(hops), called_errors_m.get(hops)),
        _times_100(step["falsely_moving"], 4, " %"),
        _times_100(window["ghost_rate"], 2, " %"),
    ]


def _errors(all_m: float | None, called_m: float | None) -> str:
    """Return the errors of all moving points, and in brackets of those called moving."""
    return f"{_times_100(all_m, 1, ' cm')} ({_times_100(called_m, 1, ' cm')})"


def _row_of_registration(scene: KeySweep) -> list[str]:
    """Return root mean square errors of the window's poses relative to the key sweep's pose."""
    sequence, key = open_sequence(scene.data), scene.key
    stretch = Recording(sequence, resolve(None), scene.window, [key]).window(key)
    error_m, error_deg = window_pose_errors(stretch, key, sequence.T_world_lidar)
    return [str(scene), f"{1000 * error_m:.0f} mm", f"{error_deg:.3f}°"]


TABLES: Mapping[str, _Table] = {
    "flow": _Table(
        "Recall of moving points, their error with missed points counted as static, and in "
        "brackets of those found.",
        "recall | one sweep | five sweeps | false positives | ghosts",
        _FLOW,
        _row_of_flow,
    ),
    "registration": _Table(
        "Errors of the poses of eleven sweeps relative to the key's, root mean square.",
        "translation | rotation",
        _REGISTERED,
        _row_of_registration,
    ),
}
