# SPDX-License-Identifier: MIT
"""The configuration: what resolves to what, and every way it can be wrong."""

from __future__ import annotations

import dataclasses
import textwrap
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from densify import config as configuration
from densify.config import (
    Config,
    FlowSettings,
    ObjectiveSettings,
    RegisterSettings,
    as_mapping,
    presets,
    resolve,
)
from densify.config.errors import InputError

KNOBS = [
    (section.name, field)
    for section in dataclasses.fields(Config)
    for field in dataclasses.fields(getattr(Config(), section.name))
]

FREE_TEXT = {("flow", "engine"), ("output", "also")}  # checked by their section


def rendered_defaults() -> str:
    """configs/default.yaml as the knobs say it must be."""
    lines = [
        "# Every knob with its default. Copy the lines you change into a file of your own and give",
        "# it with --config, or set single ones: --set project.support=6. (From densify/config.)",
    ]
    for section in dataclasses.fields(Config):
        settings = getattr(Config(), section.name)
        about = (type(settings).__doc__ or "").splitlines()[0]
        lines += ["", *textwrap.wrap(about, 96, initial_indent="# ", subsequent_indent="# ")]
        lines.append(f"{section.name}:")
        for field in dataclasses.fields(settings):
            meta = field.metadata
            limits = " | ".join(meta["choices"] or ())
            if meta["low"] is not None:
                limits = f"{meta['low']:g} to {meta['high']:g}"
            text = meta["help"] + (f" ({limits})" if limits else "")
            lines += textwrap.wrap(
                text, 96, initial_indent="  # ", subsequent_indent="  #   ", break_on_hyphens=False
            )
            value = yaml.safe_dump(field.default).splitlines()[0]
            lines.append(f"  {field.name}: {value}")
    return "\n".join(lines) + "\n"


def error_of(config: Any = None, overrides: tuple[str, ...] = ()) -> str:
    with pytest.raises(InputError) as caught:
        resolve(config, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_default_yaml_holds_every_knob_with_its_default_and_its_comment() -> None:
    text = presets()["default"].read_text("utf-8")
    assert text == rendered_defaults(), "write it again with: python tests/test_config.py"
    assert yaml.safe_load(text) == as_mapping(Config())


def test_presets_exist_and_name_only_differences() -> None:
    assert {"default", "fast", "paper"} <= set(presets())
    defaults = as_mapping(Config())
    for name, path in presets().items():
        if name == "default":
            continue
        named = yaml.safe_load(path.read_text("utf-8"))
        for section, values in named.items():
            for key, value in values.items():
                assert value != defaults[section][key], f"{name}: {section}.{key} is the default"
                assert getattr(getattr(resolve(name), section), key) == value


@pytest.mark.parametrize("section,field", KNOBS, ids=lambda v: getattr(v, "name", v))
def test_every_knob_is_documented_and_bounded(section: str, field: Any) -> None:
    meta = field.metadata
    assert len(meta["help"]) > 10
    if isinstance(field.default, bool) or (section, field.name) in FREE_TEXT:
        return
    numbers = meta["low"] is not None and meta["high"] is not None and meta["low"] < meta["high"]
    assert numbers != bool(meta["choices"]), f"{section}.{field.name}: needs bounds or choices"


@pytest.mark.parametrize("section,field", KNOBS, ids=lambda v: getattr(v, "name", v))
def test_every_knob_takes_its_limits_and_refuses_what_is_beyond(section: str, field: Any) -> None:
    meta, name = field.metadata, f"{section}.{field.name}"
    if meta["choices"]:
        for choice in meta["choices"]:
            assert (
                getattr(getattr(resolve(None, [f"{name}={choice}"]), section), field.name) == choice
            )
        assert meta["choices"][0] in error_of(None, (f"{name}=nonsense",))
    elif isinstance(field.default, bool):
        assert getattr(getattr(resolve(None, [f"{name}=false"]), section), field.name) is False
        assert "true or false" in error_of(None, (f"{name}=3",))
    elif (section, field.name) in FREE_TEXT:
        for value in (3, True, None, ["groups"]):
            message = error_of({section: {field.name: value}})
            assert f"{name}: got {value!r}, expected text" in message
    else:
        for value in (meta["low"], meta["high"]):
            got = getattr(getattr(resolve({section: {field.name: value}}), section), field.name)
            assert got == value
        for value in (
            meta["low"] - 1,
            meta["high"] * 2 + 1,
            "ten",
            True,
            [1],
            10**400,
            float("nan"),
        ):
            message = error_of({section: {field.name: value}})
            assert (
                name in message and repr(value)[:100] in message and f"{meta['low']:g}" in message
            )


def test_round_trip() -> None:
    config = resolve("paper", ["register.voxel_size_m=0.7", "flow.look_around_s=0.5"])
    text = yaml.safe_dump(as_mapping(config))
    assert resolve(yaml.safe_load(text)) == config != Config()


@settings(max_examples=20)
@given(st.floats(0.05, 10), st.floats(0, 1e6), st.booleans(), st.sampled_from(["rigid", "drop"]))
def test_round_trip_through_yaml_text(
    voxel_size_m: float, alpha: float, deskew: bool, word: str
) -> None:
    changes = {
        "register": {"voxel_size_m": voxel_size_m, "deskew": deskew},
        "objective": {"alpha": alpha},
        "accumulate": {"unfollowed": word},
    }
    config = resolve(changes)
    assert config.objective.alpha == alpha
    assert resolve(yaml.safe_load(yaml.safe_dump(as_mapping(config)))) == config


def test_file_preset_mapping_and_config_agree(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("objective:\n  alpha: 3\n")
    expected = Config(objective=ObjectiveSettings(alpha=3.0))
    assert resolve(file) == resolve(str(file)) == resolve({"objective": {"alpha": 3}}) == expected
    assert resolve(expected) == expected
    assert resolve(None) == resolve("default") == Config()
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert resolve(tmp_path / "empty.yaml") == Config()


def test_overrides_win_over_the_file_and_later_over_earlier() -> None:
    config = resolve("paper", ["objective.solver=pcg", "objective.alpha=1e1", "objective.alpha=4"])
    assert (config.flow.engine, config.objective.solver, config.objective.alpha) == (
        "paper",
        "pcg",
        4.0,
    )
    assert isinstance(config.objective.alpha, float)
    assert resolve(None, ["objective.alpha=1e1"]).objective.alpha == 10.0
    assert resolve(None, ["flow.look_around_s=null"]).flow.look_around_s is None


@pytest.mark.parametrize(
    ("override", "parts"),
    [
        ("objective.alfa=3", ["unknown key objective.alfa", "did you mean alpha?"]),
        (
            "flow.alpha=3",
            ["--set flow.alpha=3", "unknown key flow.alpha; it is objective.alpha now"],
        ),
        ("flwo.alpha=3", ["unknown section flwo", "did you mean flow?", "register, flow"]),
        ("flow.voxel_size_m=3", ["did you mean register.voxel_size_m?"]),
        ("flow.qqq=3", ["expected a key of flow: "]),
        (
            "objective.alpha=ten",
            ["--set objective.alpha=ten", "got 'ten'", "a number from 0 to 1e+06"],
        ),
        ("objective.alpha=-1", ["got -1", "from 0"]),
        ("objective.alpha=", ["got ''"]),
        ("objective.num_neighbors=2.5", ["got 2.5", "a whole number from 1 to 500"]),
        ("flow.look_around_s=-1", ["got -1", "or null"]),
        ("register.deskew=maybe", ["got 'maybe'", "true or false"]),
        ("register.source=oxts", ["got 'oxts'", "one of kiss-icp, dataset"]),
        ("flow.engine=magic", ["got 'magic'", "one of groups, pairs, paper, network:MODEL"]),
        ("project.at=noon", ["got 'noon'", "one of camera, sweep"]),
        ("output.also=rainbow", ["output.also: got 'rainbow'", "one of depth, full, flow"]),
        ("output.movers=hide", ["got 'hide'", "one of keep, drop, separate"]),
        ("objective.alpha", ["expected section.key=value"]),
        ("alpha=3", ["expected section.key=value"]),
        ("objective.alpha=[1", ["--set objective.alpha=[1", "not YAML"]),
    ],
)
def test_bad_override(override: str, parts: list[str]) -> None:
    message = error_of(None, (override,))
    for part in parts:
        assert part in message


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("objective:\n  alfa: 3\n", ["unknown key objective.alfa", "did you mean alpha?"]),
        ("flow: 3\n", ["section flow", "got 3", "mapping of keys"]),
        ("flow:\n", ["section flow", "got None"]),
        ("- flow\n", ["got ['flow']", "mapping of sections"]),
        ("objective: {alpha: [}\n", ["not YAML"]),
        (
            "objective: {alpha: 1}\nregister: {}\nobjective: {solver: adam}\n",
            ["objective is given twice"],
        ),
        ("objective: {alpha: .nan}\n", ["objective.alpha: got nan"]),
        ("3: {alpha: 1}\n", ["unknown section 3"]),
    ],
)
def test_bad_file_is_named(tmp_path: Path, text: str, parts: list[str]) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    message = error_of(file)
    for part in [str(file), *parts]:
        assert part in message


def test_binary_file_is_an_input_error(tmp_path: Path) -> None:
    file = tmp_path / "bad.yaml"
    file.write_bytes(b"\xff\xfe\x00\x80")
    assert str(file) in error_of(file)


def test_an_engine_may_be_a_folder_of_flow_files() -> None:
    assert resolve(None, ["flow.engine=npz:some/flow"]).flow.engine == "npz:some/flow"
    with pytest.raises(InputError, match="got 'npz:', expected npz:DIR"):
        FlowSettings(engine="npz:")
    with pytest.raises(InputError, match="got 'groups:9', expected groups"):
        FlowSettings(engine="groups:9")


def test_unknown_preset_suggests_one() -> None:
    message = error_of("papre")
    assert "papre" in message and "did you mean paper?" in message and "fast" in message


def test_python_users_are_checked_too() -> None:
    assert RegisterSettings(voxel_size_m=2).voxel_size_m == 2.0
    with pytest.raises(InputError, match=r"register\.voxel_size_m: got -1"):
        RegisterSettings(voxel_size_m=-1)
    with pytest.raises(InputError, match="min_range_m"):
        RegisterSettings(min_range_m=50, max_range_m=20)
    far = resolve(None, ["register.min_range_m=20", "register.max_range_m=300"])
    assert resolve({"register": {"min_range_m": 20, "max_range_m": 300}}) == far
    assert "got int" in error_of(3)


if __name__ == "__main__":
    target = Path(configuration.__file__).parents[2] / "configs" / "default.yaml"
    target.write_text(rendered_defaults(), "utf-8")
