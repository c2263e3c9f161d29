# SPDX-License-Identifier: MIT
"""Make the tables of docs/results.md again, as Markdown: ``densify bench readme``.

A table is a list of recordings with key frame numbers, and a function that measures a row. Rows of
real recordings need the folders of the recordings.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.bench.depth import bench_depth
from densify.bench.flow import bench_flow
from densify.config import resolve
from densify.config.errors import InputError, did_you_mean
from densify.geometry import poses
from densify.geometry.types import Progress
from densify.pipeline.recording import Recording
from densify.readers import open_sequence


class Scene(NamedTuple):
    """A recording and the settings of a row."""

    data: str
    keys: tuple[int, ...]  # frame numbers of the key sweeps
    camera: str = "image_02"
    window: int = 5  # number of sweeps on each side of a key sweep
    # Index of the scanner whose returns are the ground truth. None for exact ground truth or the
    # held-out key sweep.
    scanner: int | None = None

    def __str__(self) -> str:
        keys = str(self.keys[0]) if len(self.keys) == 1 else f"{self.keys[0]}-{self.keys[-1]}"
        camera = "" if self.camera == "image_02" else f", `{self.camera}`"
        return f"`{Path(self.data).name}`, key {keys}{camera}"


def _streets(text: str) -> tuple[Scene, ...]:
    """Return the scenes in a text of ``SPEC@KEY`` words, where KEY is a frame number."""
    parts = [word.rpartition("@") for word in text.split()]
    return tuple(Scene(spec, (int(key),)) for spec, _, key in parts)


_DEPTH = (
    *_streets("street?seed=41@70 street:crossing?seed=42@90 street:highway?seed=43@60"),
    Scene("street?seed=44", (100,), "image_03"),
    *_streets("street?seed=45&sensor=hdl32@80 street?seed=46&sensor=vlp16@80"),
)
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
    """A table of results.

    ``row`` returns the cells of a scene. ``real`` is True if rows of real recordings can be added.
    """

    about: str
    titles: str
    scenes: tuple[Scene, ...]
    row: Callable[[Scene], Sequence[str]]
    real: bool = False


def tables(
    names: Sequence[str],
    kitti: Path | None = None,
    pandaset: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[str]:
    """Measure tables and yield each Markdown line as soon as it is known.

    Args:
        names: Names in `TABLES`, empty for all.
        kitti: Folder of KITTI drive 2011_09_26_drive_0013_sync, None to skip its rows.
        pandaset: Folder of PandaSet sequence 002, None to skip its rows.
    """
    for name in names:
        if name not in TABLES:
            hint = did_you_mean(name, TABLES)
            raise InputError(f"bench readme {name}: {hint}expected of {', '.join(TABLES)}")
    chosen = [TABLES[name] for name in names or TABLES]
    scenes = [_scenes(table, kitti, pandaset) for table in chosen]
    done = 0
    for number, table in enumerate(chosen):
        yield "\n" * (number > 0) + f"{table.about}\n"
        yield f"| | {table.titles} |"
        yield _line(["---"] * (table.titles.count("|") + 2))
        for scene in scenes[number]:
            yield _line(table.row(scene))
            done += 1
            if progress is not None:
                progress("bench", done, sum(map(len, scenes)))


def _scenes(table: _Table, kitti: Path | None, pandaset: Path | None) -> tuple[Scene, ...]:
    real = []
    if table.real and kitti is not None:
        real.append(Scene(str(kitti), tuple(range(101, 127, 4))))
    if table.real and pandaset is not None:
        keys = tuple(range(15, 20))
        real.append(Scene(f"pandaset:{pandaset}", keys, "front_camera", scanner=1))
    return (*table.scenes, *real)


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _times_100(value: float | None, digits: int, unit: str) -> str:
    return ("–" if value is None else f"{100 * value:.{digits}f}") + unit * (value is not None)


def _row_of_depth(scene: Scene) -> list[str]:
    """Return the scores against exact ground truth, else a scanner, else the held-out key sweep."""
    sequence, config = open_sequence(scene.data), {"": resolve(None)}
    cameras, scanner = [scene.camera], scene.scanner
    measured = bench_depth(sequence, scene.keys, scene.window, config, cameras, scanner)
    scores = measured["variants"][""]["scores"]
    source = next(s for s in ("truth", "scanner", "key held out") if s in scores)
    cells = [str(scene)]
    for product, part in (("measured", "all"), ("filled", "all"), ("filled", "moving")):
        score = scores[source][product][part]
        coverage = "–" if score["coverage"] is None else f"{score['coverage']:.2f}"
        cells.append(f"{_times_100(score['outliers'], 2, ' %')} ({coverage})")
    return cells


def _row_of_flow(scene: Scene) -> list[str]:
    """Return recall, errors, false positives and ghosts of scene flow on one window."""
    sequence, key = open_sequence(scene.data), scene.keys[0]
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
    sequence, key = open_sequence(scene.data), scene.keys[0]
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
    "depth": _Table(
        "Outliers among the true pixels within a scanner's reach, and in brackets their coverage.",
        "measured | filled | moving, filled",
        _DEPTH,
        _row_of_depth,
        real=True,
    ),
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
