# SPDX-License-Identifier: MIT
"""The configuration: what resolves to what, and every way it can be wrong."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

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


def error_of(config: Any = None, overrides: tuple[str, ...] = ()) -> str:
    with pytest.raises(InputError) as caught:
        resolve(config, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_default_yaml_holds_every_knob_with_its_default_and_explains_it() -> None:
    text = presets()["default"].read_text("utf-8")
    assert yaml.safe_load(text) == as_mapping(Config())
    comments = re.findall(r"((?:^  # .*\n)+)  (\w+):", text, re.M)
    assert [name for _, name in comments] == [field.name for _, field in KNOBS]
    for (comment, name), (_, field) in zip(comments, KNOBS, strict=True):
        low, high = field.metadata.get("limits", (0, 0))
        limits = f"({low:g} to {high:g})" if high else ""
        limits = f"({' | '.join(field.metadata['words'])})" if "words" in field.metadata else limits
        assert limits in re.sub(r"\n *# *", " ", comment), name
    assert len(KNOBS) <= 28


def test_presets_name_only_differences() -> None:
    defaults = as_mapping(Config())
    assert {"default", "fast", "paper"} <= set(presets())
    for name, path in presets().items():
        for section, values in yaml.safe_load(path.read_text("utf-8")).items():
            for key, value in values.items():
                assert name == "default" or value != defaults[section][key], (name, section, key)
                assert as_mapping(resolve(name))[section][key] == value


@pytest.mark.parametrize("section,field", KNOBS, ids=lambda v: getattr(v, "name", v))
def test_every_knob_takes_its_limits_and_refuses_what_is_beyond(section: str, field: Any) -> None:
    meta = field.metadata
    if "words" in meta:
        good, bad, expected = meta["words"], ["nonsense", 3], meta["words"][0]
    elif isinstance(field.default, bool):
        good, bad, expected = [False, True], [3, "maybe"], "true or false"
    elif "limits" in meta:
        low, high = meta["limits"]
        bad = [low - 1, high * 2 + 1, "ten", True, [1], 10**400, float("nan")]
        good, expected = [low, high], f"from {low:g} to {high:g}"
    else:
        good, bad, expected = [field.default], [3, True, None, ["groups"]], "expected text"
    for value in good:
        assert as_mapping(resolve({section: {field.name: value}}))[section][field.name] == value
    for value in bad:
        message = error_of({section: {field.name: value}})
        assert f"{section}.{field.name}" in message
        assert repr(value)[:100] in message and expected in message


def test_file_preset_mapping_config_and_overrides_agree(tmp_path: Path) -> None:
    file, empty = tmp_path / "mine.yaml", tmp_path / "empty.yaml"
    file.write_text("objective:\n  alpha: 3\n")
    empty.write_text("# nothing\n")
    expected = Config(objective=ObjectiveSettings(alpha=3.0))
    assert resolve(file) == resolve(str(file)) == resolve({"objective": {"alpha": 3}}) == expected
    assert resolve(expected) == resolve(None, ["objective.alpha=3"]) == expected
    assert resolve(None) == resolve("default") == resolve(empty) == Config()
    config = resolve("paper", ["objective.solver=pcg", "objective.alpha=4", "objective.alpha=1e1"])
    assert (config.flow.engine, config.objective.solver) == ("paper", "pcg")
    assert config.objective.alpha == 10.0 and isinstance(config.objective.alpha, float)
    assert resolve(None, ["flow.look_around_s=null"]).flow.look_around_s is None
    assert resolve(None, ["flow.engine=npz:some/flow"]).flow.engine == "npz:some/flow"
    far = resolve(None, ["register.min_range_m=20", "register.max_range_m=300"])
    assert resolve({"register": {"min_range_m": 20, "max_range_m": 300}}) == far


UNFIT = "got {}, expected".format
BAD_OVERRIDES = {
    "objective.alfa=3": ["unknown key objective.alfa", "did you mean alpha?"],
    "flow.alpha=3": ["--set flow.alpha=3", "did you mean objective.alpha?"],
    "flwo.alpha=3": ["unknown section flwo", "did you mean flow?", "register, flow"],
    "flow.qqq=3": ["expected a key of flow: "],
    "objective.alpha=": [UNFIT("''")],
    "objective.num_neighbors=2.5": [UNFIT("2.5"), "a whole number from 1 to 500"],
    "flow.look_around_s=-1": [UNFIT("-1"), "or null"],
    "flow.engine=magic": ["got 'magic'", "one of groups, pairs, paper, network:MODEL"],
    "objective.alpha": ["expected section.key=value"],
    "alpha=3": ["expected section.key=value"],
    "objective.alpha=[1": ["--set objective.alpha=[1", "not YAML"],
}
BAD_FILES = {
    b"objective:\n  alfa: 3\n": ["unknown key objective.alfa", "did you mean alpha?"],
    b"flow: 3\n": ["section flow", "got 3", "mapping of keys"],
    b"- flow\n": ["got ['flow']", "mapping of sections"],
    b"objective: {alpha: [}\n": ["not YAML"],
    b"flow: {engine: pairs}\nflow: {engine: paper}\n": ["flow is given twice"],
    b"objective: {alpha: .nan}\n": ["objective.alpha: got nan"],
    b"3: {alpha: 1}\n": ["unknown section 3"],
    b"\xff\xfe\x00\x80": ["UTF-16"],
}


@pytest.mark.parametrize("bad", [*BAD_OVERRIDES, *BAD_FILES])
def test_bad_override_or_file_is_named(bad: str | bytes, tmp_path: Path) -> None:
    if isinstance(bad, str):
        message, words = error_of(None, (bad,)), BAD_OVERRIDES[bad]
    else:
        file = tmp_path / "bad.yaml"
        file.write_bytes(bad)
        message, words = error_of(file), [str(file), *BAD_FILES[bad]]
    assert all(word in message for word in words), message


def test_python_users_are_checked_too() -> None:
    assert RegisterSettings(voxel_size_m=2).voxel_size_m == 2.0
    with pytest.raises(InputError, match=r"flow\.look_around_s: got -1"):
        FlowSettings(look_around_s=-1)
    with pytest.raises(InputError, match="got 'npz:', expected npz:DIR"):
        FlowSettings(engine="npz:")
    with pytest.raises(InputError, match="min_range_m: got 50, expected less than"):
        RegisterSettings(min_range_m=50, max_range_m=20)
    assert "got int" in error_of(3)
    message = error_of("papre")
    assert "papre" in message and "did you mean paper?" in message and "fast" in message
