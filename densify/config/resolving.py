# SPDX-License-Identifier: MIT
"""Build a checked `Config` from a preset, a file, a mapping and single settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from densify.config.errors import InputError, did_you_mean
from densify.config.file_content import parse_yaml, read_yaml
from densify.config.sections import Config, Section, checked

_SECTIONS: dict[str, Any] = {f.name: type(f.default) for f in dataclasses.fields(Config)}


def resolve(
    config: Config | str | Path | Mapping[str, Any] | None = None, overrides: Sequence[str] = ()
) -> Config:
    """Return the settings given by ``config``, then changed by the overrides.

    Args:
        config: None for the defaults; a Config; a mapping ``{section: {key: value}}``; a Path to a
            YAML file of that form; or a str, the name of a preset or else of a file. Settings that
            are not given have their defaults.
        overrides: Texts ``section.key=value``, with values as in YAML; later overrides win.
    """
    values = as_mapping(config if isinstance(config, Config) else Config())
    if isinstance(config, Mapping):
        apply_changes(values, config, "configuration")
    elif isinstance(config, str | Path):
        path = _config_path(config)
        apply_changes(values, read_yaml(path)[0] or {}, str(path))
    elif not isinstance(config, Config | None):
        raise InputError(
            f"configuration: got {type(config).__name__}, expected a densify.Config, a mapping, or "
            f"the name of a preset or YAML file"
        )
    for override in overrides:
        apply_changes(values, parse_override(override), f"--set {override}")
    return Config(**{name: section(**values[name]) for name, section in _SECTIONS.items()})


def as_mapping(config: Config) -> dict[str, dict[str, Any]]:
    """Return ``{section: {key: value}}`` with every setting; `resolve` inverts it."""
    return dataclasses.asdict(config)


def presets() -> dict[str, Path]:
    """Return preset name -> its YAML file."""
    package = Path(__file__).parents[1]
    inside = package / "configs"  # installed
    folder = inside if inside.is_dir() else package.parent / "configs"  # checkout
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def parse_override(override: str) -> dict[str, dict[str, Any]]:
    """Return ``{section: {key: value}}`` from the text ``section.key=value``."""
    name, equals, text = override.partition("=")
    section, dot, key = name.strip().partition(".")
    if not (equals and dot and section and key):
        raise InputError(
            f"--set {override}: expected section.key=value, for example project.fill_reach=1"
        )
    value, _ = parse_yaml(text, f"--set {override}")
    return {section: {key: value if text.strip() else ""}}


def _config_path(name: str | Path) -> Path:
    path = presets().get(name, Path(name)) if isinstance(name, str) else name
    if path.is_file():
        return path
    hint = _expected(str(name), presets(), "preset")
    raise InputError(f"configuration {name}: no such preset or file; {hint}")


def apply_changes(
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
            values[name][key] = checked(sections[name], key, value, f"{where}: ")


def _mapping(value: Any, where: str, content: str) -> Iterable[tuple[Any, Any]]:
    if not isinstance(value, Mapping):
        raise InputError(
            f"{where}: got {value!r}, expected a mapping of {content}, for example "
            f"project: {{fill_reach: 1}}"
        )
    return value.items()


def _expected(got: str, known: Mapping[str, Any], kind: str) -> str:
    return f"{did_you_mean(got, known)}expected a {kind}: {', '.join(known)}"
