# SPDX-License-Identifier: MIT
"""``densify bench readme``: the tables of docs/results.md, made again as Markdown.

Each table is a list of recordings and keys, and one function that measures a row. Real recordings
are rows where their folders are given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.bench.depth import bench_depth
from densify.bench.flow import bench_flow
from densify.config import Config, resolve
from densify.config.errors import InputError, did_you_mean
from densify.geometry import poses
from densify.geometry.types import Progress
from densify.pipeline import run as pipeline
from densify.pipeline.recording import Recording
from densify.readers import open_sequence

_METHODS = ("none", "icp", "icp-far", "flow")


class Scene(NamedTuple):
    """A recording and its keys. window: sweeps on each side. scanner: whose returns are the truth,
    None for exact truth or the key held out."""

    data: str
    keys: tuple[int, ...]
    camera: str = "image_02"
    window: int = 5
    scanner: int | None = None

    def __str__(self) -> str:
        keys = str(self.keys[0]) if len(self.keys) == 1 else f"{self.keys[0]}-{self.keys[-1]}"
        camera = "" if self.camera == "image_02" else f", `{self.camera}`"
        return f"`{Path(self.data).name}`, key {keys}{camera}"


def _streets(text: str) -> tuple[Scene, ...]:
    """Return the scenes of a text of ``SPEC@KEY``."""
    parts = [word.rpartition("@") for word in text.split()]
    return tuple(Scene(spec, (int(key),)) for spec, _, key in parts)


_PRESETS = _streets("""
    street@120 street:crossing@120 street:highway@120 street:static@120
    street?seed=31@120 street:crossing?seed=32@120 street:highway?seed=33@120
""")
_DEPTH = (
    *_streets("street?seed=41@70 street:crossing?seed=42@90 street:highway?seed=43@60"),
    Scene("street?seed=44", (100,), "image_03"),
    *_streets("street?seed=45&sensor=hdl32@80 street?seed=46&sensor=vlp16@80"),
)
_FLOW = _streets("""
    street?seed=21@70 street:crossing?seed=22@90 street:highway?seed=23@110
    street:static?seed=24@60 street?seed=25&sensor=hdl32@70
    street:crossing?seed=26&sensor=vlp16@90 street?seed=27&sensor=dual32@60
""")
_RINGS = _streets("""
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
_RATES = tuple(
    Scene(f"{data}?hz={hz}", (12 * hz,), window=hz // 2)
    for data in ("street", "street:crossing", "street:highway", "street:static")
    for hz in (5, 10, 20)
)
_PARTS = {
    "all parts": (),
    "no far range": ("accumulate.far_m=0",),
    "no boundary pixels": ("project.rims=strict",),
    "no car windows": ("project.glass=keep",),
    "no two-sided fill": ("project.fill_reach=0.1",),
}


class _Table(NamedTuple):
    """rows: the cells of a scene, a line each. real: has rows of real recordings."""

    about: str
    titles: str
    scenes: tuple[Scene, ...]
    rows: Callable[[Scene], Sequence[Sequence[str]]]
    real: bool = False


def tables(
    names: Sequence[str],
    kitti: Path | None = None,
    pandaset: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[str]:
    """Make the tables of these names, all of `TABLES` if none, and yield each line when measured.

    kitti: the folder of drive 2011_09_26_drive_0013_sync. pandaset: that of sequence 002.
    Raises InputError for other names, ComputationError where registration went wrong.
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
            for cells in table.rows(scene):
                yield _line(cells)
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


def _percent(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f}"


def _centimetres(value_m: float | None) -> str:
    return "–" if value_m is None else f"{100 * value_m:.1f} cm"


def _rows_of_methods(scene: Scene) -> list[list[str]]:
    """Return `_METHODS` beside each other against exact truth."""
    sequence, key = open_sequence(scene.data), scene.keys[0]
    made = pipeline.compare(sequence, key, scene.window, [scene.camera], methods=_METHODS)
    scores = [made[name].metrics for name in _METHODS]

    def cells(digits: int, *path: str) -> str:
        values: list[Any] = scores
        for step in path:
            values = [value[step] for value in values]
        known = any(value is not None for value in values)
        return f"{', '.join(_percent(v, digits) for v in values)} %" if known else ""

    depth, ours = ("depth", scene.camera, "measured"), scores[-1]
    filled = ours["depth"][scene.camera]["filled"]["all"]["outliers"]
    density = ours["density"][scene.camera]["filled"]
    return [
        [
            f"`{scene.data}`",
            cells(1, "density", scene.camera, "measured"),
            cells(2, *depth, "all", "outliers"),
            cells(1, *depth, "moving", "outliers"),
            cells(0, *depth, "moving", "coverage"),
            f"{_percent(filled)} % at {_percent(density, 0)} %",
            f"{_percent(scores[1]['ghosts']['all'])}, {_percent(ours['ghosts']['all'])} %",
        ]
    ]


def _rows_of_parts(scene: Scene) -> list[list[str]]:
    variants = {name: resolve(None, changes) for name, changes in _PARTS.items()}
    return [[f"{scene}: {name}", *cells] for name, cells in _depth_cells(scene, variants)]


def _depth_cells(scene: Scene, variants: Mapping[str, Config]) -> Iterator[tuple[str, list[str]]]:
    """Yield the cells of each variant against the best truth there is."""
    sequence, cameras = open_sequence(scene.data), [scene.camera]
    measured = bench_depth(sequence, scene.keys, scene.window, variants, cameras, scene.scanner)
    for name, numbers in measured["variants"].items():
        scores = numbers["scores"]
        source = next(s for s in ("truth", "scanner", "key held out") if s in scores)
        cells = []
        for product, part in (("measured", "all"), ("filled", "all"), ("filled", "moving")):
            score = scores[source][product][part]
            cells.append("–" if score["coverage"] is None else f"{score['coverage']:.2f}")
            cells.append(f"{_percent(score['outliers'])} %")
        yield name, cells


def _rows_of_rates(scene: Scene) -> list[list[str]]:
    """Return flow over 0.4 s at any rate, and the maps."""
    ((_, depth),) = _depth_cells(scene, {"": resolve(None)})
    return [[str(scene), *_flow_cells(scene, round(0.8 * scene.window)), *depth[:4]]]


def _flow_cells(scene: Scene, num_sweeps: int) -> list[str]:
    sequence, key = open_sequence(scene.data), scene.keys[0]
    ours = bench_flow(sequence, key, scene.window, resolve(None), ["ours"])["methods"]["ours"]
    step, window = ours["step"], ours["window"]
    hops = str(num_sweeps)
    all_m, found_m = (window[f"{which}movers_m_by_hops"].get(hops) for which in ("", "found_"))
    return [
        f"{_percent(step['found'], 1)} %",
        f"{_centimetres(step['movers_m'])} ({_centimetres(step['found_movers_m'])})",
        f"{_centimetres(all_m)} ({_centimetres(found_m)})",
        f"{_percent(step['falsely_moving'], 4)} %",
        f"{_percent(window['ghost_rate'])} %",
    ]


def _rows_of_registration(scene: Scene) -> list[list[str]]:
    """Return the root mean square errors of the window's poses relative to the key's."""
    sequence, key = open_sequence(scene.data), scene.keys[0]
    stretch = Recording(sequence, resolve(None), scene.window, [key]).window(key)
    T_true_world = poses.inverse(sequence.T_world_lidar(key))
    off = [
        poses.log(
            poses.inverse(T_true_world @ sequence.T_world_lidar(frame))
            @ stretch.T_target_source(key, frame)
        )
        for frame in stretch.frames
    ]
    rotation, translation = (
        np.sqrt((part**2).sum(axis=1).mean()) for part in np.hsplit(np.array(off), 2)
    )
    return [[str(scene), f"{1000 * translation:.0f} mm", f"{np.rad2deg(rotation):.3f}°"]]


_FLOW_TITLES = "found | one sweep | five sweeps | falsely moving | ghosts"
_DEPTH_TITLES = "measured | outliers | filled | outliers | moving, filled | outliers"
TABLES: Mapping[str, _Table] = {
    "methods": _Table(
        "One sweep, ICP, ICP over 40 m of road each way, ours; measured depth except where filled.",
        "density | outliers | outliers, moving objects | coverage, moving objects "
        "| ours, filled: outliers at density | ghosts: ICP, ours",
        _PRESETS,
        _rows_of_methods,
    ),
    "depth": _Table(
        "Coverage of the true pixels within a scanner's reach, and outliers.",
        _DEPTH_TITLES,
        _DEPTH,
        lambda scene: [[str(scene), *c] for _, c in _depth_cells(scene, {"": resolve(None)})],
        real=True,
    ),
    "parts": _Table(
        "The same without each part of a map.", _DEPTH_TITLES, _DEPTH[:4], _rows_of_parts, real=True
    ),
    "flow": _Table(
        "Moving points found, their error with missed points counted as static, and in brackets of "
        "those found.",
        _FLOW_TITLES,
        _FLOW,
        lambda scene: [[str(scene), *_flow_cells(scene, scene.window)]],
    ),
    "rings": _Table(
        "The same with 32 and 16 rings, and a rosette.",
        _FLOW_TITLES,
        _RINGS,
        lambda scene: [[str(scene), *_flow_cells(scene, scene.window)]],
    ),
    "rates": _Table(
        "The same streets at 5, 10 and 20 Hz, half a second on each side.",
        f"{_FLOW_TITLES.replace('five sweeps', '0.4 s')} | measured | outliers | filled | outliers",
        _RATES,
        _rows_of_rates,
    ),
    "registration": _Table(
        "Errors of the poses of eleven sweeps relative to the key's, root mean square.",
        "translation | rotation",
        _REGISTERED,
        _rows_of_registration,
    ),
}
