# SPDX-License-Identifier: MIT
"""Readers, engines and outputs of other packages: one that works, and all that can be wrong."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace

import numpy as np
import pytest

import densify
from densify.config import resolve
from densify.config.errors import InputError
from densify.config.plugins import READERS, engine
from densify.flow.engines import check_engine
from densify.outputs.store import check_writable, write_result
from densify.readers import Spec
from tests.tiny_street import MOVERS, tiny

EXAMPLE = Path(__file__).parents[1] / "examples" / "plugin"


# --- the example, installed ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the example is installed in."""
    folder = tmp_path_factory.mktemp("site")
    offline = ["--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
    install = [sys.executable, "-m", "pip", "install", "-q", *offline, "--target", str(folder)]
    done = subprocess.run([*install, str(EXAMPLE)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording in the example's format, with traffic."""
    folder, recorded = tmp_path_factory.mktemp("sweeps"), tiny(MOVERS)
    for frame in range(4, 9):
        sweep = recorded[frame]
        columns = np.column_stack([sweep.points, sweep.intensity]).astype(np.float32)
        np.save(folder / f"{frame:06d}.npy", columns)
    return folder


def command(installed: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    paths = [str(installed), *filter(None, [os.environ.get("PYTHONPATH")])]
    return subprocess.run(
        [sys.executable, "-m", "densify", *map(str, arguments)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
    )


def test_the_example_reads_estimates_and_writes(
    installed: Path, sweeps: Path, tmp_path: Path
) -> None:
    options = ["--key", 7, "--window", 1, "--flow", "still", "--set", "output.also=txt"]
    done = command(installed, "run", "--data", sweeps, *options, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "out" / "000007"
    assert str(folder / "cloud.txt") in done.stdout.splitlines()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["num_moving"] == 0 < metrics["num_points"]
    cloud = np.loadtxt(folder / "cloud.txt")
    assert cloud.shape == (metrics["num_points"], 3)
    assert np.linalg.norm(cloud, axis=1).max() > 20
    told = command(installed, "info", "--data", f"npy:{sweeps}")
    assert told.returncode == 0 and "4-8 (5, no gaps)" in told.stdout, told.stdout + told.stderr


# --- packages that are wrong ---------------------------------------------------------------------


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Makes a package with one entry point that this process finds."""

    def make(group: str, name: str, code: str, package: str = "stranger") -> str:
        folder = tmp_path / package
        about = folder / f"{package}-1.0.dist-info"
        about.mkdir(parents=True)
        (folder / f"{package}_code.py").write_text(dedent(code))
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text(f"[{group}]\n{name} = {package}_code\n")
        monkeypatch.syspath_prepend(str(folder))
        monkeypatch.delitem(sys.modules, f"{package}_code", raising=False)
        return f"{package}_code"

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
    with pytest.raises(InputError, match="no known recording there; expected a KITTI raw drive"):
        densify.open_sequence(there)
    package("densify.readers", "marked", code)
    with pytest.raises(InputError, match=", marks or a folder"):
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


RESULT = SimpleNamespace(
    **{name: {} for name in ("depth", "full", "movers", "optical_flow", "rejected", "metrics")},
    **{"baselines": {}, "flow": None, "key": 3, "method": "flow", "frames": (3,), "costs": ()},
    **{"far_frames": (), "warnings": (), "stamp_ns": 0, "T_key_lidar": {}},
    far_left_out=(),
    images={},
    cloud=None,
)


def written(out: Path, monkeypatch: pytest.MonkeyPatch, also: str) -> list[str]:
    monkeypatch.setattr("densify.outputs.key_outputs.write_cloud", lambda *_: None)
    paths = write_result(RESULT, out, config={}, data="here", also=also)
    return [path.relative_to(out / "000003").as_posix() for path in paths]


def test_an_output_of_another_package(package, tmp_path: Path, monkeypatch) -> None:
    code = """
        OWNED = ("notes",)
        def write_output(result, context, folder):
            (folder / "notes").mkdir()
            (folder / "notes" / "about.txt").write_text(f"{context.data} {result.key}")
    """
    package("densify.outputs", "notes", code)
    assert resolve({"output": {"also": "notes"}}).output.also == "notes"
    out = tmp_path / "out"
    mine = written(out, monkeypatch, " notes, notes")
    assert mine == ["metrics.json", "run.yaml", "notes/about.txt"]
    assert (out / "000003" / "notes" / "about.txt").read_text() == "here 3"
    with pytest.raises(InputError, match=r"metrics\.json, run\.yaml, notes already there"):
        check_writable(out, 3, also="notes")
    assert written(tmp_path / "without", monkeypatch, "") == ["metrics.json", "run.yaml"]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ('OWNED = ("x",)\ndef write_output(r, c, f): (f / "y").touch()', "wrote y, expected noth"),
        ("def write_output(r, c, f): pass", "stranger_code says no OWNED"),
        ('OWNED = ("depth",)\ndef write_output(r, c, f): pass', "would write depth of the output"),
    ],
)
def test_an_output_writes_its_own_files_only(
    package, code: str, words: str, tmp_path: Path, monkeypatch
) -> None:
    package("densify.outputs", "strange", code)
    with pytest.raises(InputError, match=words):
        written(tmp_path / "out", monkeypatch, "strange")
    assert not (tmp_path / "out").exists()
