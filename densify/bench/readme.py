# SPDX-License-Identifier: MIT
"""Make the tables of docs/results.md again, as Markdown: ``densify bench readme``.

A table is a list of streets with key frame numbers, and a function that measures a row. The tables
of depth are those of ``densify bench gate``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from densify.bench.flow import bench_flow
from densify.config import resolve
from densify.config.errors import InputError, did_you_mean
from densify.geometry import poses
from densify.geometry.types import Progress
from densify.pipeline.recording import Recording
from densify.readers import open_sequence


class Scene(NamedTuple):
    """A street and the key sweep of a row."""

    data: str
    key: int  # frame number
    window: int = 5  # number of sweeps on each side of the key sweep

    def __str__(self) -> str:
        return f"`{self.data}`, key {self.key}"


def _streets(text: str) -> tuple[Scene, ...]:
    """Return the scenes in a text of ``SPEC@KEY`` words, where KEY is a frame number."""
    parts = [word.rpartition("@") for word in text.split()]
    return tuple(Scene(spec, int(key)) for spec, _, key in parts)


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
    ours = bench_flow(sequence, key, scene.window, resolve(None), ["ours"])["methods"]["ours"]
    step, window = ours["step"], ours["window"]
    hops = str(scene.window)
    all_m, found_m = (window[f"{which}movers_m_by_hops"].get(hops) for which in ("", "found_"))
    one, one_found, five, five_found = (
        _times_100(error_m, 1, " cm")
        for error_m in (step["movers_m"], step["found_movers_m"], all_m, found_m)
    )
    return [
        str(scene),
        _times_100(step["found"], 1, " %"),
        f"{one} ({one_found})",
        f"{five} ({five_found})",
        _times_100(step["falsely_moving"], 4, " %"),
        _times_100(window["ghost_rate"], 2, " %"),
    ]


def _row_of_registration(scene: Scene) -> list[str]:
    """Return root mean square errors of the window's poses relative to the key sweep's pose."""
    sequence, key = open_sequence(scene.data), scene.key
    stretch = Recording(sequence, resolve(None), scene.window, [key]).window(key)
    T_true_world = poses.inverse(sequence.T_world_lidar(key))
    off = []
    for frame in stretch.frames:
        T_true = T_true_world @ sequence.T_world_lidar(frame)
        off.append(poses.log(poses.inverse(T_true) @ stretch.T_target_source(key, frame)))
    rotation, translation = (
        np.sqrt((part**2).sum(axis=1).mean()) for part in np.hsplit(np.array(off), 2)
    )
    return [str(scene), f"{1000 * translation:.0f} mm", f"{np.rad2deg(rotation):.3f}°"]


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
