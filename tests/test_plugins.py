# SPDX-License-Identifier: MIT
"""Readers and engines of other packages: one that works, and all that can be wrong."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

import densify
from densify.config import resolve
from densify.config.errors import InputError
from densify.config.plugins import READERS, engine
from densify.flow.engines import check_engine
from densify.readers import Spec
from tests.tiny_street import MOVERS, tiny

EXAMPLE = Path(__file__).parents[1] / "examples" / "plugin"


def test_the_example_installs_reads_and_estimates(tmp_path: Path) -> None:
    site, sweeps, recorded = tmp_path / "site", tmp_path / "sweeps", tiny(MOVERS)
    sweeps.mkdir()
    for frame in range(4, 9):
        sweep = recorded[frame]
        columns = np.column_stack([sweep.points, sweep.intensity]).astype(np.float32)
        np.save(sweeps / f"{frame:06d}.npy", columns)
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    python("pip", "install", "-q", *offline, "--target", site, EXAMPLE)
    paths = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    options = ["--key", 7, "--window", 1, "--flow", "still", "--out", tmp_path / "out"]
    python("densify", "run", "--data", sweeps, *options, PYTHONPATH=paths)
    metrics = json.loads((tmp_path / "out" / "000007" / "metrics.json").read_text())
    assert metrics["num_moving"] == 0 < metrics["num_points"]
    printed = python("densify", "info", "--data", f"npy:{sweeps}", PYTHONPATH=paths)
    assert "4-8 (5, no gaps)" in printed


def python(*arguments: object, **environment: str) -> str:
    """What a module of Python, run as a program, prints."""
    done = subprocess.run(
        [sys.executable, "-m", *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes a package with one entry point that this process finds."""

    def make(group: str, name: str, code: str) -> str:
        folder, module = tmp_path / "stranger", "stranger_code"
        about = folder / "stranger-1.0.dist-info"
        about.mkdir(parents=True)
        (folder / f"{module}.py").write_text(dedent(code))
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[{group}]\n{name} = {module}\n")
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.delitem(sys.modules, module, raising=False)
        return module

    return make


STILL = """
    from dataclasses import dataclass
    ARGUMENT, SHARED = "N", True
    @dataclass
    class Still:
        number: int
    def estimate_motion(scene, settings, argument) -> Still:
        return Still(int(argument))
    def check_argument(argument):
        from densify.config.errors import InputError
        if not argument.isdigit():
            raise InputError(f"flow.engine still:{argument}: expected a number")
"""


def test_a_module_says_what_a_row_says(package) -> None:
    module = package("densify.flow_engines", "still", STILL)
    assert resolve(None, ["flow.engine=still:3"]).flow.engine == "still:3"
    assert module not in sys.modules  # the configuration imports none
    row, argument = engine("still:3")
    assert (row.name, row.module) == ("still", module)
    assert row.shared and row.usage == "still:N" and argument == "3"
    check_engine("still:3")
    with pytest.raises(InputError, match="still:x: expected a number"):
        check_engine("still:x")
    with pytest.raises(InputError, match=r"'stil', did you mean still\? .*npz:DIR, still \("):
        resolve(None, ["flow.engine=stil"])


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("raise RuntimeError('a\\nb')", "cannot be imported from stranger_code (RuntimeError: a"),
        ("x = 1", "stranger_code is no module with estimate_motion"),
    ],
)
def test_a_broken_package_is_named_in_one_line(package, code: str, words: str) -> None:
    package("densify.flow_engines", "broken", code)
    check_engine("groups")  # what is not asked for breaks nothing
    with pytest.raises(InputError, match=re.escape(words)) as error:
        check_engine("broken")
    message = str(error.value)
    assert "engine broken of the package stranger: " in message and "\n" not in message


def test_a_reader_of_another_package(package, tmp_path: Path) -> None:
    code = """
        HOLDS, SCENES = "marks", True
        def recognises(path):
            return (path / "mark").exists()
        def open_recording(path, scene):
            return path, scene
    """
    data = tmp_path / "data"
    there = data / "there"
    there.mkdir(parents=True)
    with pytest.raises(InputError, match=r"no recording: it is empty; expected .*kitti, .*, ros,"):
        densify.open_sequence(there)
    package("densify.readers", "marked", code)
    with pytest.raises(InputError, match=", marked, folder"):
        densify.open_sequence(there)
    (there / "mark").touch()
    (data / "labels").mkdir()  # numbered, and named before it
    (data / "labels" / "0013.txt").touch()
    with pytest.raises(InputError, match=f"one in it is {there}: name that"):
        densify.open_sequence(data)
    with pytest.raises(InputError, match=r"no such folder; did you mean marked\? expected"):
        densify.open_sequence(f"markd:{data}")
    assert densify.open_sequence(there) == (there, None)
    assert densify.open_sequence(f"marked:{data}#night") == (data, "night")
    assert Spec.parse("marked:here").absolute() == f"marked:{Path.cwd()}/here"
    assert [row.name for row in READERS][-2:] == ["marked", "folder"]
