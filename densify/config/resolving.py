# SPDX-License-Identifier: MIT
"""Makes a checked `Config` of a preset, a file, a mapping and single knobs."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import parse_yaml, read_yaml
from densify.config.knobs import checked
from densify.config.sections import REMOVED, Config


def resolve(
    config: Config | str | Path | Mapping[str, Any] | None = None, overrides: Sequence[str] = ()
) -> Config:
    """Return the configuration that `config` and the overrides name.

    config: None for the defaults; a Config; a mapping ``{section: {key: value}}``; a Path to a YAML
        file of that form; or a str, the name of a preset (`presets`) or else a file. Only
        differences from the defaults need to be named.
    overrides: ``section.key=value`` each, values written as in YAML; later ones win.

    Raises InputError for anything unknown (suggesting the right name), of the wrong type or out of
    range, naming the file or ``--set`` that it comes from.
    """
    values = as_mapping(config if isinstance(config, Config) else Config())
    if isinstance(config, Mapping):
        _apply(values, config, "configuration")
    elif isinstance(config, str | Path):
        path = _config_path(config)
        _apply(values, read_yaml(path)[0] or {}, str(path))
    elif not isinstance(config, Config | None):
        raise InputError(
            f"configuration: got {type(config).__name__}, expected a densify.Config, a mapping, or "
            f"the name of a preset or YAML file"
        )
    for override in overrides:
        _apply(values, _parse_override(override), f"--set {override}")
    return Config(**{name: section(**values[name]) for name, section in _sections().items()})


def as_mapping(config: Config) -> dict[str, dict[str, Any]]:
    """Return ``{section: {key: value}}`` with every key; `resolve` makes the Config again."""
    return dataclasses.asdict(config)


def presets() -> dict[str, Path]:
    """Return the YAML file of each preset by name."""
    package = Path(__file__).parents[1]
    inside = package / "configs"  # installed
    folder = inside if inside.is_dir() else package.parent / "configs"  # checkout
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _config_path(name: str | Path) -> Path:
    if isinstance(name, str) and name in presets():
        return presets()[name]
    path = Path(name)
    if path.is_file():
        return path
    raise InputError(
        f"configuration {name}: no such preset or file; {_expected(str(name), presets(), 'preset')}"
    )


def _parse_override(override: str) -> Mapping[str, Any]:
    name, equals, text = override.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise InputError(
            f"--set {override}: expected section.key=value, for example project.support=6"
        )
    value, _ = parse_yaml(text, f"--set {override}")
    return {section: {key: value if text.strip() else ""}}


def _apply(values: dict[str, dict[str, Any]], changes: Any, where: str) -> None:
    """Write the checked `changes` over `values`."""
    _require_mapping(changes, where, "sections")
    for name, keys in changes.items():
        if name not in values:
            hint = _removed(name) or _expected(str(name), values, "section")
            raise InputError(f"{where}: unknown section {name}; {hint}")
        _require_mapping(keys, f"{where}: section {name}", "keys")
        for key, value in keys.items():
            if key not in values[name]:
                hint = _key_hint(name, str(key), values)
                raise InputError(f"{where}: unknown key {name}.{key}; {hint}")
            values[name][key] = checked(_sections()[name], key, value, f"{where}: ")


def _sections() -> dict[str, Any]:
    """Return the classes of the sections by name."""
    return typing.get_type_hints(Config)


def _require_mapping(value: Any, where: str, content: str) -> None:
    if not isinstance(value, Mapping):
        raise InputError(
            f"{where}: got {value!r}, expected a mapping of {content}, for example "
            f"project: {{support: 6}}"
        )


def _key_hint(section: str, key: str, values: Mapping[str, Mapping[str, Any]]) -> str:
    """Return what became of the key, its section if that is another, or the key most like it."""
    for other, keys in values.items():
        if key in keys:
            return f"did you mean {other}.{key}?"
    return _removed(section, key) or _expected(key, values[section], f"key of {section}")


def _removed(section: Any, key: str = "") -> str:
    """Return what to do about a knob or section of an earlier version, "" if there was none."""
    known = key in REMOVED.get(section, "").split() if key else section in REMOVED
    return "this version has a fixed value for it: leave it out" if known else ""


def _expected(got: str, known: Mapping[str, Any], kind: str) -> str:
    return f"{did_you_mean(got, known)}expected a {kind}: {', '.join(known)}"
