# SPDX-License-Identifier: MIT
"""``densify bench readme``: the tables of docs/results.md, made again as Markdown.

Each table is a list of recordings and keys, and one function that measures a row. Streets have
exact truth; of those with a seed none was looked at when parameters were chosen, except where the
table says so. Real recordings are rows where their folders are given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from densify.bench.depth import bench_depth
from densify.bench.flow import bench_flow
from densify.bench.images import FAULTS as WRONG_IMAGES
from densify.bench.images import bench_images
from densify.bench.priors import FAULTS, Completed, bench_priors
from densify.bench.registration import bench_registration
from densify.bench.two_clouds import bench_two_clouds
from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.geometry.types import Progress
from densify.pipeline import run as pipeline
from densify.readers import open_sequence

_METHODS = ("none", "icp", "icp-far", "flow")


class Scene(NamedTuple):
    """window: sweeps on each side. scanner: whose returns are the truth, None for none."""

    data: str
    keys: tuple[int, ...]
    camera: str = "image_02"
    window: int = 5
    scanner: int | None = None

    def __str__(self) -> str:
        keys = str(self.keys[0]) if len(self.keys) == 1 else f"{self.keys[0]}-{self.keys[-1]}"
        return f"`{Path(self.data).name}`, key {keys}" + (
            "" if self.camera == "image_02" else f", `{self.camera}`"
        )


_PRESETS = tuple(
    Scene(data, (120,))
    for data in (
        "street",
        "street:crossing",
        "street:highway",
        "street:static",
        "street?seed=31",
        "street:crossing?seed=32",
        "street:highway?seed=33",
    )
)
_DEPTH = (
    Scene("street?seed=41", (70,)),
    Scene("street:crossing?seed=42", (90,)),
    Scene("street:highway?seed=43", (60,)),
    Scene("street?seed=44", (100,), "image_03"),
    Scene("street?seed=45&sensor=hdl32", (80,)),
    Scene("street?seed=46&sensor=vlp16", (80,)),
)
_FLOW = (
    Scene("street?seed=21", (70,)),
    Scene("street:crossing?seed=22", (90,)),
    Scene("street:highway?seed=23", (110,)),
    Scene("street:static?seed=24", (60,)),
    Scene("street?seed=25&sensor=hdl32", (70,)),
    Scene("street:crossing?seed=26&sensor=vlp16", (90,)),
    Scene("street?seed=27&sensor=dual32", (60,)),
)
_RINGS = (
    Scene("street:highway?seed=28&sensor=hdl32", (70,)),
    Scene("street:crossing?seed=52&sensor=hdl32", (80,)),
    Scene("street:highway?seed=53&sensor=hdl32", (80,)),
    Scene("street:highway?seed=57&sensor=hdl32", (80,)),
    Scene("street:crossing?seed=60&sensor=hdl32", (80,)),
    Scene("street?seed=63&sensor=hdl32", (80,)),
    Scene("street:highway?seed=29&sensor=vlp16", (70,)),
    Scene("street?seed=51&sensor=vlp16", (80,)),
    Scene("street:highway?seed=54&sensor=vlp16", (80,)),
    Scene("street:crossing?seed=55&sensor=vlp16", (80,)),
    Scene("street:highway?seed=58&sensor=vlp16", (80,)),
    Scene("street?seed=59&sensor=vlp16", (80,)),
    Scene("street:crossing?seed=64&sensor=vlp16", (80,)),
    Scene("street?seed=207&sensor=rosette", (82,)),
    Scene("street?seed=421&sensor=rosette", (70,)),
    Scene("street:crossing?seed=422&sensor=rosette", (70,)),
)
_REGISTERED = (
    Scene("street", (120,)),
    Scene("street:crossing", (120,)),
    Scene("street:highway", (120,)),
    Scene("street:highway?seed=43", (60,)),
    Scene("street?seed=59", (80,)),
    Scene("street:highway?seed=30&sensor=dual32", (70,)),
    *_RINGS[:3],
    _RINGS[5],
    *_RINGS[6:10],
    _RINGS[11],
    Scene("street:crossing?seed=304&sensor=rosette", (90,)),
)
_RATES = tuple(
    Scene(f"{data}{'&' if '?' in data else '?'}hz={hz}", (12 * hz,), window=hz // 2)
    for data in ("street", "street:crossing", "street:highway", "street:static")
    for hz in (5, 10, 20)
)
_PAIRS = tuple(
    Scene(f"{data}?seed={seed}&sensor=dual32", (30, 60, 90, 120))
    for data, seed in zip(
        ("street", "street:crossing", "street:highway") * 3 + ("street",),
        (*range(61, 67), 81, 82, 83, 84),
        strict=True,
    )
)
_PRIORS = (
    Scene("street?seed=71", (60,)),
    Scene("street:crossing?seed=72", (90,)),
    Scene("street:highway?seed=73", (60,)),
    Scene("street?seed=74", (100,), "image_03"),
)
_IMAGES = (
    Scene("street?seed=41", (70,)),
    Scene("street:highway?seed=43", (60,)),
    Scene("street?seed=61&sensor=hdl32", (80,)),
)
_PARTS = {
    "all parts": (),
    "no far range": ("accumulate.far_m=0",),
    "no rims": ("project.rims=strict",),
    "no windows": ("project.glass=keep",),
    "no two-sided fill": ("project.fill_reach=0.1",),
}


_SEGMENTED: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "the objective, faster than 0.5 m/s": ("paper", ()),
    "ICP by clusters, the same": ("cluster-icp", ()),
    "ours": ("ours", ()),
    "ours, `network:streets`": ("ours", ("flow.engine=network:streets",)),
}


class _Table(NamedTuple):
    """row: the cells of a scene, one line or several. kitti, pandaset: real scenes by folder."""

    about: str
    titles: tuple[str, ...]
    scenes: tuple[Scene, ...]
    row: Callable[[Scene], list[list[str]]]
    real: bool = False


def tables(
    names: Sequence[str],
    kitti: Path | None = None,
    pandaset: Path | None = None,
    progress: Progress | None = None,
) -> Iterator[str]:
    """Make the tables of these names, `TABLES`, and yield the lines of each as they are measured.

    kitti: the folder of drive 2011_09_26_drive_0013_sync. pandaset: that of sequence 002. Their
    rows are left out where none is given.

    Raises InputError for other names, ComputationError where registration went wrong.
    """
    for name in names:
        if name not in TABLES:
            raise InputError(f"bench readme {name}: expected of {', '.join(TABLES)}")
    chosen = [TABLES[name] for name in names or TABLES]
    done, total = 0, sum(len(_scenes(table, kitti, pandaset)) for table in chosen)
    for number, table in enumerate(chosen):
        yield "\n" * (number > 0) + f"{table.about}\n"
        yield _line(("", *table.titles))
        yield _line(["---"] * (len(table.titles) + 1))
        for scene in _scenes(table, kitti, pandaset):
            for cells in table.row(scene):
                yield _line(cells)
            done += 1
            if progress is not None:
                progress("bench", done, total)


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


def _row_of_methods(scene: Scene) -> list[list[str]]:
    """`_METHODS` beside each other against exact truth."""
    sequence, key = open_sequence(scene.data), scene.keys[0]
    made = pipeline.compare(sequence, key, scene.window, [scene.camera], methods=_METHODS)
    scores = [made[name].metrics for name in _METHODS]

    def cells(digits: int, of: Callable[[Mapping[str, Any]], float | None]) -> str:
        return f"{', '.join(_percent(of(score), digits) for score in scores)} %"

    def truth(part: str, number: str) -> Callable[[Mapping[str, Any]], float | None]:
        return lambda score: score["depth"][scene.camera]["measured"][part][number]

    ours, filled = scores[-1], scores[-1]["depth"][scene.camera]["filled"]
    density = ours["density"][scene.camera]["filled"]
    moves = truth("moving", "coverage")(ours) is not None
    return [
        [
            f"`{scene.data}`",
            cells(1, lambda score: score["density"][scene.camera]["measured"]),
            cells(2, truth("all", "outliers")),
            cells(1, truth("moving", "outliers")) if moves else "",
            cells(0, truth("moving", "coverage")) if moves else "",
            f"{_percent(filled['all']['outliers'])} % at {_percent(density, 0)} %",
            f"{_percent(scores[1]['ghosts']['all'])}, {_percent(ours['ghosts']['all'])} %",
        ]
    ]


def _row_of_depth(scene: Scene) -> list[list[str]]:
    """Measured and filled maps against the best truth there is."""
    return [[str(scene), *cells] for _, cells in _depth_cells(scene, {"": resolve(None)})]


def _rows_of_parts(scene: Scene) -> list[list[str]]:
    """The same without each part of a map."""
    variants = {name: resolve(None, changes) for name, changes in _PARTS.items()}
    rows = _depth_cells(scene, variants)
    return [[f"{scene}: {name}", *cells] for name, cells in rows]


def _depth_cells(scene: Scene, variants: Mapping[str, Config]) -> Iterator[tuple[str, list[str]]]:
    cameras = [scene.camera]
    measured = bench_depth(
        open_sequence(scene.data), scene.keys, scene.window, variants, cameras, scene.scanner
    )
    for name, numbers in measured["variants"].items():
        scores = numbers["scores"]
        source = next(s for s in ("truth", "scanner", "key held out") if s in scores)
        cells = []
        for product, part in (("measured", "all"), ("filled", "all"), ("filled", "moving")):
            score = scores[source][product][part]
            coverage = score["coverage"]
            cells.append("–" if coverage is None else f"{coverage:.2f}")
            cells.append(f"{_percent(score['outliers'])} %")
        yield name, [*cells, f"{numbers['seconds']:.1f}"]


def _row_of_flow(scene: Scene) -> list[list[str]]:
    """Our flow: one sweep, and the same number of sweeps as the window has on each side."""
    ours = _ours(scene)
    return [[str(scene), *_flow_cells(ours, scene.window), _worst(ours["worst_object"])]]


def _row_of_rates(scene: Scene) -> list[list[str]]:
    """Our flow over 0.4 s at any rate, and the maps made of it."""
    flow = _flow_cells(_ours(scene), round(0.8 * scene.window))
    ((_, depth),) = _depth_cells(scene, {"": resolve(None)})
    return [[str(scene), *flow, *depth[:4]]]


def _ours(scene: Scene) -> Mapping[str, Any]:
    sequence, key = open_sequence(scene.data), scene.keys[0]
    measured = bench_flow(sequence, key, scene.window, resolve(None), ["ours"])
    ours: Mapping[str, Any] = measured["methods"]["ours"]
    return ours


def _worst(measured: Mapping[str, Any] | None) -> str:
    """The object that most of the error is of, and what made it hard."""
    if measured is None:
        return ""
    seen = f"{measured['num_sweeps']} of {measured['num_pairs']} sweeps"
    return (
        f"{measured['distance_m']:.0f} m away, {measured['speed_m_s']:.1f} m/s, "
        f"{measured['num_returns']:.0f} returns in each of {seen}: "
        f"{_percent(measured['found'], 0)} % found, {_centimetres(measured['error_m'])} off, "
        f"{_percent(measured['share_of_error'], 0)} % of all error"
    )


def _row_of_registration(scene: Scene) -> list[list[str]]:
    """Poses against exact ones."""
    off = bench_registration(open_sequence(scene.data), scene.keys[0], scene.window)
    return [[str(scene), f"{1000 * off.rms_m:.0f} mm", f"{off.rms_deg:.3f}°"]]


def _flow_cells(ours: Mapping[str, Any], num_sweeps: int) -> list[str]:
    step, window, hops = ours["step"], ours["window"], str(num_sweeps)

    def cell(of_all: float | None, of_found: float | None) -> str:
        return f"{_centimetres(of_all)} ({_centimetres(of_found)})"

    return [
        f"{_percent(step['found'], 1)} %",
        cell(step["movers_m"], step["found_movers_m"]),
        cell(window["movers_m_by_hops"].get(hops), window["found_movers_m_by_hops"].get(hops)),
        f"{_percent(step['falsely_moving'], 4)} %",
        f"{_percent(window['ghost_rate'])} %",
    ]


def _rows_of_segmentation(scene: Scene) -> list[list[str]]:
    """What moves and what is one object, as methods of pairs and as engines see it."""
    sequence, key = open_sequence(scene.data), scene.keys[0]
    rows = []
    for name, (method, changes) in _SEGMENTED.items():
        config = resolve(None, changes)
        measured = bench_flow(sequence, key, scene.window, config, [method])
        found = measured["methods"][method]["segmentation"]
        numbers = ("moving_iou", "panoptic_quality", "recognition", "segmentation")
        counts = ("num_found", "num_missed", "num_false")
        cells = [_percent(found[n], 1) + " %" for n in numbers]
        rows.append([f"{scene}: {name}", *cells, *(str(found[n]) for n in counts)])
    return rows


def _row_of_pairs(scene: Scene) -> list[list[str]]:
    """`densify.estimate_flow` on four pairs, by what it is given."""
    scores = bench_two_clouds(open_sequence(scene.data), scene.keys).values()

    def cell(number: str, scale: float, digits: int, unit: str) -> str:
        values = (f"{scale * getattr(score, number):.{digits}f}" for score in scores)
        return f"{', '.join(values)} {unit}"

    return [
        [
            str(scene),
            cell("movers_m", 100, 1, "cm"),
            cell("within_10cm", 100, 0, "%"),
            cell("standing_m", 1000, 1, "mm"),
            cell("falsely_moving", 100, 3, "%"),
        ]
    ]


def _row_of_images(scene: Scene) -> list[list[str]]:
    """Wrong pixels with wrong images, as multiples of those without rims."""
    key = scene.keys[len(scene.keys) // 2]
    made = bench_images(open_sequence(scene.data), key, scene.camera, scene.window)
    cells = [", ".join(map(str, parts)) for parts in made.values()]
    return [[str(scene._replace(keys=(key,))), *cells]]


def _row_of_priors(scene: Scene) -> list[list[str]]:
    """Pixels that came from priors, by the right kind and scale alone and as fitted."""
    made = bench_priors(open_sequence(scene.data), scene.keys[0], scene.camera)

    def cell(found: Completed) -> str:
        if not found.share:
            return "not used"
        outliers = _percent(found.scaled.outliers, 1), _percent(found.fitted.outliers, 1)
        return f"{' → '.join(outliers)} %, {found.scaled.abs_rel:.3f} → {found.fitted.abs_rel:.3f}"

    share = max(found.share for found in made.values())
    return [[str(scene), f"{_percent(share, 0)} %", *map(cell, made.values())]]


def _centimetres(value_m: float | None) -> str:
    return "–" if value_m is None else f"{100 * value_m:.1f} cm"


_FLOW_TITLES = ("found", "one sweep", "five sweeps", "falsely moving", "ghosts", "worst object")
_DEPTH_TITLES = (
    "measured",
    "wrong",
    "filled",
    "wrong",
    "movers, filled",
    "wrong",
    "seconds after the cloud",
)
TABLES: Mapping[str, _Table] = {
    "methods": _Table(
        "One sweep, ICP, ICP over 40 m of road each way, ours; measured depth but where it says "
        "filled (seeds 31 to 33: looked at).",
        (
            "density",
            "outliers",
            "on moving objects",
            "movers' coverage",
            "ours, filled: outliers at density",
            "ghosts: ICP, ours",
        ),
        _PRESETS,
        _row_of_methods,
    ),
    "depth": _Table(
        "Coverage of the truth's pixels within a scanner's reach, and wrong ones.",
        _DEPTH_TITLES,
        _DEPTH,
        _row_of_depth,
        real=True,
    ),
    "parts": _Table(
        "The same without each part of a map.", _DEPTH_TITLES, _DEPTH[:4], _rows_of_parts, real=True
    ),
    "flow": _Table(
        "Moving points found, errors with missed points counted as standing still, and in brackets "
        "of those found; the object that most of the error over one sweep is of.",
        _FLOW_TITLES,
        _FLOW,
        _row_of_flow,
    ),
    "rings": _Table(
        "The same with 32 and 16 rings, and a rosette.", _FLOW_TITLES, _RINGS, _row_of_flow
    ),
    "registration": _Table(
        "Poses of eleven sweeps off the exact ones, relative to the key's, root mean square.",
        ("metres", "degrees"),
        _REGISTERED,
        _row_of_registration,
    ),
    "rates": _Table(
        "The same streets at 5, 10 and 20 Hz, half a second on each side (looked at).",
        ("found", "one sweep", "0.4 s", "falsely moving", "ghosts", *_DEPTH_TITLES[:4]),
        _RATES,
        _row_of_rates,
    ),
    "segmentation": _Table(
        "What moves in each of eleven sweeps, above the ground, and which of it is one object (50 "
        "points or more; methods that know none link what moves within 0.6 m).",
        (
            "IoU of moving",
            "panoptic quality",
            "recognition",
            "segmentation",
            "found",
            "missed",
            "false",
        ),
        _FLOW[:3],
        _rows_of_segmentation,
    ),
    "pairs": _Table(
        "Two clouds alone, of two scanners half a turn apart, four pairs each: of points alone, "
        "with firing times, with scanner numbers besides; within 35 m and above the ground, missed "
        "points counted as standing still.",
        ("movers", "within 10 cm", "what stands", "falsely moving"),
        _PAIRS,
        _row_of_pairs,
    ),
    "prior": _Table(
        "Exact depth as the prior, made worse: wrong pixels and mean relative error of what came "
        "from it, with the right kind and scale alone → as fitted.",
        ("of the image", *FAULTS),
        _PRIORS,
        _row_of_priors,
    ),
    "images": _Table(
        "Filled pixels that are wrong with wrong images, as a multiple of those with "
        "project.rims=strict, and in brackets among the most certain ones, as many as it has; –: "
        "the image is not listened to.",
        (*WRONG_IMAGES, "the next frame's"),
        _IMAGES,
        _row_of_images,
        real=True,
    ),
}
