# SPDX-License-Identifier: MIT
"""Make the tables of docs/results.md again, as Markdown: ``densify bench readme``.

A table is a list of streets with key frame numbers, and a function that measures a row. The tables
of depth are those of ``densify bench gate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

from densify.bench.flow import bench_flow
from densify.config import resolve
from densify.config.errors import InputError, did_you_mean
from densify.geometry.types import Progress
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.scores.pose_metrics import window_pose_errors


class Scene(NamedTuple):
    """A street and the key sweep of a row."""

    data: str
    key: int  # frame number
    window: int = 5  # number of sweeps on each side of the key sweep

    def __str__(self) -> str:
        return f"`{self.data}`, key {self.key}"


def _streets(text: str) -> tuple[Scene, ...]:
    """Return the scenes in a text of ``SPEC@KEY`` words, where KEY is a frame number."""
    words = [word.rpartition("@") for word in text.split()]
    return tuple(Scene(spec, int(key)) for spec, _, key in words)


_FLOW = _streets("""
    street?seed=21@70 street:crossing?seed=22@90 street:highway?seed=23@110
    street:static?seed=24@60 street?seed=25&sensor=hdl32@70
    street:crossing?seed=26&sensor=vlp16@90 street?seed=27&sensor=dual32@60
    street:highway?seed=28&sensor=hdl32@70 street:crossing?seed=60&sensor=hdl32@80
    street?seed=63&sensor=hdl32@80 street:highway?seed=29&sensor=vlp16@70
    street?seed=59&sensor=vlp16@80 street:crossing?seed=64&sensor=vlp16@80
    street?seed=421&sensor=rosette@70 street:crossing?seed=422&sensor=rosette@70
""")
_REGISTERED = _streets("""
    street@120 street:crossing@120 street:highway@120 street?seed=59@80
    street:highway?seed=30&sensor=dual32@70 street:highway?seed=28&sensor=hdl32@70
    street?seed=63&sensor=hdl32@80 street:highway?seed=29&sensor=vlp16@70
    street?seed=59&sensor=vlp16@80 street:crossing?seed=304&sensor=rosette@90
""")


class _Table(NamedTuple):
    """A table of results. ``row`` returns the cells of a scene."""

    about: str
    titles: str
    scenes: tuple[Scene, ...]
    row: Callable[[Scene], Sequence[str]]


def tables(names: Sequence[str], progress: Progress | None = None) -> Iterator[str]:
    """Measure the tables of `names` in `TABLES` (empty for all); yield each Markdown line."""
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
        yield _line(["---"] * (table.titles.count("|") + 2))
        for scene in table.scenes:
            yield _line(table.row(scene))
            done += 1
            if progress is not None:
                progress("bench", done, num_scenes)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _times_100(value: float | None, digits: int, unit: str) -> str:
    return ("–" if value is None else f"{100 * value:.{digits}f}") + unit * (value is not None)


def _row_of_flow(scene: Scene) -> list[str]:
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


def _row_of_registration(scene: Scene) -> list[str]:
    """Return root mean square errors of the window's poses relative to the key sweep's pose."""
    sequence, key = open_sequence(scene.data), scene.key
    stretch = Recording(sequence, resolve(None), scene.window, [key]).window(key)
    off_m, off_deg = window_pose_errors(stretch, key, sequence.T_world_lidar)
    return [str(scene), f"{1000 * off_m:.0f} mm", f"{off_deg:.3f}°"]


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
