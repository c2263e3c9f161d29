# SPDX-License-Identifier: MIT
"""Every knob of the pipeline, in one place: a frozen dataclass per stage, collected in `Config`.

To add a knob, add one line to a section here and run ``python tests/test_config.py``, which writes
its line into configs/default.yaml. To add a section, add its class and one line in `Config`.
"""

from __future__ import annotations

import dataclasses
import difflib
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from densify.errors import InputError
from densify.knobs import Section, checked, knob
from densify.plugins import engines


@dataclass(frozen=True)
class RegisterSettings(Section):
    """Where the lidar was at every sweep."""

    source: str = knob(
        "kiss-icp",
        "kiss-icp: estimate the poses from the sweeps; dataset: take the recording's own",
        choices=("kiss-icp", "dataset"),
    )
    num_lead_in: int = knob(
        5,
        "sweeps registered before the window so that odometry knows the speed; more is safer",
        0,
        50,
    )
    voxel_size_m: float = knob(
        0.5,
        "[m] cell of the local map; smaller is finer and slower, too small loses track",
        0.05,
        10,
    )
    min_range_m: float = knob(2.8, "[m] nearer returns, the own vehicle's, are left out", 0, 50)
    max_range_m: float = knob(120.0, "[m] farther returns are left out", 5, 500)
    deskew: bool = knob(True, "undo the motion within each sweep; off only for compensated sweeps")
    max_speed_m_s: float = knob(
        60.0, "[m/s] a faster step between two sweeps is an error of registration", 1, 200
    )
    min_overlap: float = knob(
        0.55,
        "share of what stands in a sweep that must lie on the sweep before; right poses gave 0.73 "
        "(16 beams, 25 m/s) to 0.98",
        0,
        1,
    )
    min_num_points: int = knob(1000, "a sweep with fewer points cannot be registered", 1, 1_000_000)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_range_m >= self.max_range_m:
            raise InputError(
                f"register.min_range_m: got {self.min_range_m:g}, expected less than "
                f"register.max_range_m = {self.max_range_m:g}"
            )


@dataclass(frozen=True)
class GroundSettings(Section):
    """How high every point is above the ground."""

    cell_m: float = knob(1.0, "[m] grid cell; smaller follows kerbs, larger bridges holes", 0.1, 10)
    max_slope: float = knob(
        0.15, "rise per metre; steeper is taken for an object, less for ground", 0.01, 1
    )


@dataclass(frozen=True)
class FlowSettings(Section):
    """What moves, and how."""

    engine: str = knob(
        "groups",
        f"{engines.described()}; others by name where their package is installed",
    )
    min_height_m: float = knob(
        0.2,
        "[m] points lower above the ground start no motion; smaller sees kerbs move, larger loses "
        "what is flat",
        0.02,
        2,
    )
    soft: bool = knob(
        True,
        "objects bend about their rigid motion (swinging limbs) as far as held-out sweeps confirm",
    )
    solver: str = knob(
        "pcg",
        "of the objective (engine paper, or densify flow without static_prior). pcg: conjugate "
        "gradients, fast; adam: 1,500 steps as published",
        choices=("pcg", "adam"),
    )
    alpha: float = knob(
        10.0, "of the objective: weight of smoothness; larger moves neighbours more alike", 0, 1e6
    )
    num_neighbors: int = knob(
        50, "of the objective: neighbours in the graph; more is stiffer and slower", 1, 500
    )
    radius_m: float | None = knob(
        None,
        "[m] join the points within this radius, at most the num_neighbors nearest; null: off",
        0.01,
        20,
    )
    laplacian: str = knob(
        "symmetric",
        "of the objective. symmetric: as published; row-sum-zero: leaves a constant flow free",
        choices=("symmetric", "row-sum-zero"),
    )
    max_gap_m: float = knob(
        0.5,
        "[m] of chained flow (engine paper): a moved point farther than this from the next sweep's "
        "moving points is lost",
        0.01,
        10,
    )
    static_prior: bool = knob(
        True,
        "points not proven to move keep exactly their rigid place; off moves every point, with "
        "engine paper and in the flow of two files",
    )
    device: str = knob(
        "auto", "of the objective; auto: CUDA where there is one", choices=("auto", "cpu", "cuda")
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        engines.check_spec(self.engine)


@dataclass(frozen=True)
class AccumulateSettings(Section):
    """All points at the key's moment."""

    unfollowed: str = knob(
        "drop",
        "points that move but cannot be followed. drop: leave them out; rigid: keep them where "
        "registration puts them, as ghosts",
        choices=("rigid", "drop"),
    )


@dataclass(frozen=True)
class ProjectSettings(Section):
    """From the accumulated cloud to each camera's depth map."""

    at: str = knob(
        "camera",
        "the moment a depth map shows. camera: the image's own exposure, ego motion and movers "
        "included; sweep: the key sweep's reference time",
        choices=("camera", "sweep"),
    )
    visibility: bool = knob(
        True, "off: each pixel's nearest point as it is; what is hidden shines through (a baseline)"
    )
    veto_m: float = knob(
        0.3,
        "[m] a point of another sweep this much or veto_fraction of its range (the larger) before "
        "what the key sweep saw there is left out; smaller finds more ghosts and loses thin things",
        0,
        10,
    )
    veto_fraction: float = knob(0.015, "see veto_m; share of the range", 0, 1)
    footprint: float = knob(
        0.4,
        "half size of the patch a point stands for, in spacings of neighbouring rays; larger hides "
        "more of what shines through gaps and eats background beside near objects",
        0,
        5,
    )
    slack_m: float = knob(
        0.05, "[m] added to that half size, for errors of registration and flow", 0, 1
    )
    hidden_m: float = knob(
        0.2,
        "[m] a point this much plus hidden_fraction behind the nearest patch is hidden; smaller "
        "removes more ghosts and more of rough and slanted surfaces",
        0,
        10,
    )
    hidden_fraction: float = knob(0.06, "see hidden_m; share of the depth", 0, 1)
    support: int = knob(
        4,
        "sweeps that must agree with a point, the one nearest to the key among them; at most half "
        "of those there are; more removes what was badly registered and thins far surfaces",
        1,
        20,
    )
    support_reach: float = knob(
        0.8, "how far around a pixel they are looked for, in spacings of neighbouring rays", 0.1, 5
    )
    plane_reach: float = knob(
        0.5,
        "how far a pixel's depth is averaged, in spacings; larger is smoother and rounds what is "
        "curved",
        0,
        5,
    )
    agree_m: float = knob(
        0.1, "[m] points agree that deviate less than this plus agree_fraction", 0.001, 5
    )
    agree_fraction: float = knob(0.01, "see agree_m; share of the depth", 0, 1)
    edge_reach: float = knob(
        0.35,
        "a point nearer than this to the edge of its surface is left out, in spacings along the "
        "azimuth: beams are about as wide; smaller fattens outlines, larger eats thin things",
        0,
        5,
    )
    edge_slack_m: float = knob(
        0.015, "[m] added to that, for errors of registration and flow", 0, 1
    )
    fill_reach: float = knob(
        1.0,
        "how far the two-sided fill looks for measured pixels, in spacings of neighbouring rays; "
        "below 1 nothing is filled between the lines of a single sweep",
        0.1,
        5,
    )
    edge_m: float = knob(
        0.1,
        "[m] no pixel is filled where depths around it deviate more from a plane; larger fills "
        "hedges and ragged edges, often wrongly",
        0,
        10,
    )
    edge_fraction: float = knob(0.01, "the same as a share of the depth; the larger counts", 0, 1)
    fill_confidence: float = knob(
        0.5,
        "confidence of a pixel filled from afar as a share of the least around it",
        0,
        1,
    )


@dataclass(frozen=True)
class OutputSettings(Section):
    """What is written beside the files that every run writes."""

    flow: bool = knob(False, "flow/: scene flow of every sweep to the next one, as flow files")
    optical_flow: bool = knob(
        False,
        "optical_flow/: of every pixel with a measured depth to the previous and the next image, "
        "as KITTI flow PNG",
    )
    rejected: bool = knob(
        False, "rejected/: a picture of what visibility left out, and why; counts in metrics.json"
    )
    movers: str = knob(
        "keep",
        "what moves. keep: as all else; drop: left out of maps and cloud; separate: left out and "
        "written object by object under movers/",
        choices=("keep", "drop", "separate"),
    )


@dataclass(frozen=True)
class Config:
    """The whole configuration; ``Config()`` is the default one. Sections mirror the stages."""

    register: RegisterSettings = dataclasses.field(default_factory=RegisterSettings)
    ground: GroundSettings = dataclasses.field(default_factory=GroundSettings)
    flow: FlowSettings = dataclasses.field(default_factory=FlowSettings)
    accumulate: AccumulateSettings = dataclasses.field(default_factory=AccumulateSettings)
    project: ProjectSettings = dataclasses.field(default_factory=ProjectSettings)
    output: OutputSettings = dataclasses.field(default_factory=OutputSettings)


def resolve(
    config: Config | str | Path | Mapping[str, Any] | None = None, overrides: Sequence[str] = ()
) -> Config:
    """The configuration that `config` and the overrides name.

    config: None for the defaults; a Config; a mapping ``{section: {key: value}}``; a Path to a YAML
        file of that form; or a str, the name of a preset (`presets`) or else a file. Only
        differences from the defaults need to be named.
    overrides: ``section.key=value`` each, values written as in YAML; later ones win.

    Raises InputError for anything unknown (suggesting the right name), of the wrong type or out of
    range, naming the file or ``--set`` it comes from.
    """
    if isinstance(config, Config):
        values = as_mapping(config)
    else:
        values = as_mapping(Config())
        if isinstance(config, Mapping):
            _apply(values, config, "configuration")
        elif isinstance(config, str | Path):
            path = _config_path(config)
            _apply(values, _read_yaml(_read_text(path), str(path)) or {}, str(path))
        elif config is not None:
            raise InputError(
                f"configuration: got {type(config).__name__}, expected a densify.Config, a "
                f"mapping, or the name of a preset or YAML file"
            )
    for override in overrides:
        _apply(values, _parse_override(override), f"--set {override}")
    return Config(**{name: section(**values[name]) for name, section in _sections().items()})


def as_mapping(config: Config) -> dict[str, dict[str, Any]]:
    """Plain ``{section: {key: value}}``, every key; ``resolve(as_mapping(config)) == config``."""
    return dataclasses.asdict(config)


def presets() -> dict[str, Path]:
    """Preset name -> its YAML file."""
    inside = Path(__file__).parent / "configs"  # installed
    folder = inside if inside.is_dir() else Path(__file__).parents[1] / "configs"  # checkout
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _config_path(name: str | Path) -> Path:
    if isinstance(name, str) and name in presets():
        return presets()[name]
    path = Path(name)
    if path.is_file():
        return path
    raise InputError(
        f"configuration {name}: no such preset or file; "
        f"{_suggestion(str(name), list(presets()), 'preset')}"
    )


def _read_text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a YAML file: {error}") from error


def _read_yaml(text: str, where: str) -> Any:
    """Parsed YAML, None for an empty text; a key given twice is an error."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            keys = [str(key.value) for key, _ in node.value]
            for key in keys:
                if keys.count(key) > 1:
                    line = node.start_mark.line + 1
                    raise InputError(f"{where}: {key} is given twice from line {line} on; keep one")
            return super().construct_mapping(node, deep)

    try:
        return yaml.load(text, Loader)
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date that is none, say
        reason = " ".join(str(error).split())
        raise InputError(f"{where}: not YAML: {reason}") from error


def _parse_override(override: str) -> Mapping[str, Any]:
    name, equals, text = override.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise InputError(f"--set {override}: expected section.key=value, for example flow.alpha=5")
    value = _read_yaml(text, f"--set {override}")
    return {section: {key: value if text.strip() else ""}}


def _apply(values: dict[str, dict[str, Any]], changes: Any, where: str) -> None:
    """Write the checked `changes` over `values`."""
    _require_mapping(changes, where, "sections")
    for name, keys in changes.items():
        if name not in values:
            raise InputError(
                f"{where}: unknown section {name}; {_suggestion(name, list(values), 'section')}"
            )
        _require_mapping(keys, f"{where}: section {name}", "keys")
        for key, value in keys.items():
            if key not in values[name]:
                hint = _key_suggestion(name, str(key), values)
                raise InputError(f"{where}: unknown key {name}.{key}; {hint}")
            values[name][key] = checked(_sections()[name], key, value, f"{where}: ")


def _sections() -> dict[str, Any]:
    """Section name -> its class."""
    return typing.get_type_hints(Config)


def _require_mapping(value: Any, where: str, content: str) -> None:
    if not isinstance(value, Mapping):
        raise InputError(
            f"{where}: got {value!r}, expected a mapping of {content}, for example "
            f"flow: {{alpha: 5}}"
        )


def _key_suggestion(section: str, key: str, values: Mapping[str, Mapping[str, Any]]) -> str:
    """The same key in another section, else the nearest one of this."""
    for other, keys in values.items():
        if key in keys:
            return f"did you mean {other}.{key}?"
    return _suggestion(key, list(values[section]), f"{section} key")


def _suggestion(got: str, known: Sequence[str], kind: str) -> str:
    close = difflib.get_close_matches(str(got), known, n=1, cutoff=0.6)
    hint = f"did you mean {close[0]}? " if close else ""
    return f"{hint}expected a {kind}: {', '.join(known)}"
