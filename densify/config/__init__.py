# SPDX-License-Identifier: MIT
"""Define every setting of the pipeline, and resolve presets, files and changes to a `Config`.

Each stage has a frozen dataclass. A new setting needs a comment in configs/default.yaml, a new
section a line in `Config`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import parse_yaml, read_yaml
from densify.config.plugins import check_engine_spec

_FEW_POINTS_PER_S = 800_000  # 64 rings have 1.2 million, 32 have 700,000
# Time around the window in which motion is searched, for sparse and for dense sweeps
_AROUND_FEW_S, _AROUND_S = 0.5, 0.3


def number_field(default: float | None, low: float, high: float) -> Any:
    """Return a dataclass field for a number from ``low`` to ``high``, both included."""
    return field(default=default, metadata={"limits": (low, high)})


def choice_field(*words: str) -> Any:
    """Return a dataclass field for one of the texts ``words``; the first one is the default."""
    return field(default=words[0], metadata={"words": words})


@dataclass(frozen=True)
class Section:
    """The settings of one stage; construction raises InputError for a value that does not fit."""

    def __post_init__(self) -> None:
        for knob in fields(self):
            value = _convert_value(type(self), knob.name, getattr(self, knob.name), "")
            object.__setattr__(self, knob.name, value)


def _convert_value(section: type[Section], key: str, value: Any, where: str) -> Any:
    """Return a user's value converted to the type of its setting, or raise InputError."""
    knob = section.__dataclass_fields__[key]
    kind, _, optional = str(knob.type).partition(" | ")
    if optional and value is None:
        return None
    got = value
    if kind == "float" and isinstance(value, str | int) and not isinstance(value, bool):
        with suppress(ValueError, OverflowError):
            value = float(value)  # text too: YAML 1.1 reads 1e-3 as text
    fits = type(value).__name__ == kind
    if words := knob.metadata.get("words"):
        fits, expected = fits and value in words, f"one of {', '.join(words)}"
    elif limits := knob.metadata.get("limits"):
        fits = fits and limits[0] <= value <= limits[1]
        expected = f"a {'whole ' * (kind == 'int')}number from {limits[0]:g} to {limits[1]:g}"
    else:
        expected = "true or false" if kind == "bool" else "text"
    if fits:
        return value
    name = f"{section.__name__.removesuffix('Settings').lower()}.{key}"
    raise InputError(
        f"{where}{name}: got {got!r}, expected {expected}{' or null' * bool(optional)}"
    )


@dataclass(frozen=True)
class RegisterSettings(Section):
    """Settings for the pose of the lidar at every sweep."""

    source: str = choice_field("kiss-icp", "dataset")
    voxel_size_m: float = number_field(0.5, 0.05, 10)
    min_range_m: float = number_field(2.8, 0, 50)
    max_range_m: float = number_field(120.0, 5, 500)
    deskew: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.min_range_m >= self.max_range_m:
            raise InputError(
                f"register.min_range_m: got {self.min_range_m:g}, expected less than "
                f"register.max_range_m = {self.max_range_m:g}"
            )


@dataclass(frozen=True)
class FlowSettings(Section):
    """Settings for scene flow."""

    engine: str = "groups"
    look_around_s: float | None = number_field(None, 0, 5)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_engine_spec(self.engine)

    def around(self, points_per_s: float) -> tuple[float, float]:
        """Return in seconds how far around a window motion is searched, and the step of the search.

        A step of 0 means every sweep. ``points_per_s`` is the rate of the lidar. Sparse sweeps show
        little of a moving object: all of them are searched, and farther.
        """
        is_sparse = points_per_s < _FEW_POINTS_PER_S
        needed_s, step_s = (_AROUND_FEW_S, 0.0) if is_sparse else (_AROUND_S, _AROUND_S)
        return needed_s if self.look_around_s is None else self.look_around_s, step_s


@dataclass(frozen=True)
class ObjectiveSettings(Section):
    """Settings of engine paper; all but static_prior also apply to the flow of two point files."""

    solver: str = choice_field("pcg", "adam")
    alpha: float = number_field(10.0, 0, 1e6)
    num_neighbors: int = number_field(50, 1, 500)
    static_prior: bool = True


@dataclass(frozen=True)
class AccumulateSettings(Section):
    """Settings for the accumulated cloud at the key's time."""

    unfollowed: str = choice_field("drop", "rigid")
    far_m: float = number_field(40.0, 0, 500)


@dataclass(frozen=True)
class ProjectSettings(Section):
    """Settings for depth maps of the accumulated cloud."""

    at: str = choice_field("camera", "sweep")
    per: str = choice_field("sweep", "image")
    depth: str = choice_field("auto", "z", "range")
    visibility: bool = True
    rims: str = choice_field("image", "strict", "keep")
    fill_reach: float = number_field(1.5, 0.1, 5)
    max_outliers: float | None = number_field(None, 0.0001, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.per == "image" and self.at == "sweep":
            raise InputError(
                "project.per=image: each map shows its image's own exposure; got project.at=sweep, "
                "expected camera"
            )


@dataclass(frozen=True)
class PriorSettings(Section):
    """Settings for depth images from the user (--prior), which complete unmeasured pixels."""

    kind: str = choice_field("auto", "depth", "inverse")


@dataclass(frozen=True)
class OutputSettings(Section):
    """Settings for files in addition to the files that every run writes."""

    flow: str = choice_field("none", "npz")
    optical_flow: bool = False
    rejected: bool = False
    score: bool = False
    report: bool = False
    movers: str = choice_field("keep", "drop", "separate")


@dataclass(frozen=True)
class Config:
    """The whole configuration, one section per stage; ``Config()`` has the defaults.

    ``configs/default.yaml`` describes each setting.
    """

    register: RegisterSettings = RegisterSettings()
    flow: FlowSettings = FlowSettings()
    objective: ObjectiveSettings = ObjectiveSettings()
    accumulate: AccumulateSettings = AccumulateSettings()
    project: ProjectSettings = ProjectSettings()
    prior: PriorSettings = PriorSettings()
    output: OutputSettings = OutputSettings()

    @property
    def is_scored(self) -> bool:
        """True if results have baselines and are scored against the held-out key sweep."""
        return self.output.score or self.output.report

    def scored(self) -> Config:
        """Return a copy of this configuration with ``output.score`` set to True."""
        return replace(self, output=replace(self.output, score=True))


_SECTIONS: dict[str, Any] = {f.name: type(f.default) for f in fields(Config)}


def resolve(
    config: Config | str | Path | Mapping[str, Any] | None = None, overrides: Sequence[str] = ()
) -> Config:
    """Return all settings: the defaults, changed by ``config`` and then by the overrides.

    Args:
        config: None for the defaults; a Config; a mapping ``{section: {key: value}}``; a Path to a
            YAML file of that form; or a str, the name of a preset or else of a file. Settings that
            are not given have their defaults.
        overrides: Texts ``section.key=value``, with values as in YAML. Later ones win.

    Raises:
        InputError: A file, section or key does not exist, or a value does not fit its setting.
    """
    values = as_mapping(config if isinstance(config, Config) else Config())
    if isinstance(config, Mapping):
        _apply_changes(values, config, "configuration")
    elif isinstance(config, str | Path):
        path = presets().get(config, Path(config)) if isinstance(config, str) else config
        if not path.is_file():
            hint = _expected(str(config), presets(), "preset")
            raise InputError(f"configuration {config}: no such preset or file; {hint}")
        _apply_changes(values, read_yaml(path)[0] or {}, str(path))
    elif not isinstance(config, Config | None):
        raise InputError(
            f"configuration: got {type(config).__name__}, expected a densify.Config, a mapping, or "
            f"the name of a preset or YAML file"
        )
    apply_overrides(values, overrides)
    return Config(**{name: section(**values[name]) for name, section in _SECTIONS.items()})


def as_mapping(config: Config) -> dict[str, dict[str, Any]]:
    """Return every setting as ``{section: {key: value}}``, from which `resolve` makes it again."""
    return asdict(config)


def find_changes(config: Config) -> dict[str, dict[str, Any]]:
    """Return ``{section: {key: value}}`` with the settings that differ from their defaults."""
    defaults = as_mapping(Config())
    changes = {
        section: {key: value for key, value in keys.items() if value != defaults[section][key]}
        for section, keys in as_mapping(config).items()
    }
    return {section: keys for section, keys in changes.items() if keys}


def presets() -> dict[str, Path]:
    """Return the path of the YAML file of each preset, by the preset's name."""
    package = Path(__file__).parents[1]
    inside = package / "configs"  # installed
    folder = inside if inside.is_dir() else package.parent / "configs"  # checkout
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def apply_overrides(
    values: dict[str, dict[str, Any]],
    overrides: Iterable[str],
    sections: Mapping[str, type[Section]] = _SECTIONS,
) -> None:
    """Overwrite settings ``{section: {key: value}}`` in place by texts ``section.key=value``.

    ``sections`` has the class of each section. Raise InputError for a text of another form, an
    unknown key, or a value that does not fit.
    """
    for override in overrides:
        where = f"--set {override}"
        name, equals, text = override.partition("=")
        section, dot, key = name.strip().partition(".")
        if not (equals and dot and section and key):
            raise InputError(
                f"{where}: expected section.key=value, for example project.fill_reach=1"
            )
        value = parse_yaml(text, where)[0] if text.strip() else ""
        _apply_changes(values, {section: {key: value}}, where, sections)


def _apply_changes(
    values: dict[str, dict[str, Any]],
    changes: Any,
    where: str,
    sections: Mapping[str, type[Section]] = _SECTIONS,
) -> None:
    """Overwrite settings ``{section: {key: value}}`` in place; errors begin with ``where``."""
    for name, keys in _mapping(changes, where, "sections"):
        if name not in values:
            hint = _expected(str(name), values, "section")
            raise InputError(f"{where}: unknown section {name}; {hint}")
        for key, value in _mapping(keys, f"{where}: section {name}", "keys"):
            if key not in values[name]:
                hint = _expected(str(key), values[name], f"key of {name}")
                owners = [section for section, known in values.items() if key in known]
                hint = f"did you mean {owners[0]}.{key}?" if owners else hint
                raise InputError(f"{where}: unknown key {name}.{key}; {hint}")
            values[name][key] = _convert_value(sections[name], key, value, f"{where}: ")


def _mapping(value: Any, where: str, content: str) -> Iterable[tuple[Any, Any]]:
    """Return the items of a mapping; raise InputError for other values."""
    if not isinstance(value, Mapping):
        raise InputError(
            f"{where}: got {value!r}, expected a mapping of {content}, for example "
            f"project: {{fill_reach: 1}}"
        )
    return value.items()


def _expected(got: str, known: Mapping[str, Any], kind: str) -> str:
    """Return the end of a message: the name most similar to ``got``, and all known names."""
    return f"{did_you_mean(got, known)}expected a {kind}: {', '.join(known)}"
