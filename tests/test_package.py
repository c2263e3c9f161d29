# SPDX-License-Identifier: MIT
"""The package as it is installed: lazy, whole, and the one that is meant."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from importlib.metadata import entry_points, version
from pathlib import Path

import pytest

import densify
from densify.config import Config, as_mapping, presets, resolve

CHECKOUT = Path(__file__).parents[1]
CODE = {path: path.read_text("utf-8") for path in sorted((CHECKOUT / "densify").rglob("*.py"))}
PAGES = {
    path: path.read_text("utf-8")
    for path in (CHECKOUT / "README.md", *sorted((CHECKOUT / "docs").rglob("*.md")))
}
HEAVY = {
    *("numpy", "scipy", "torch", "matplotlib", "embreex", "kiss_icp", "small_gicp", "cv2"),
    *("laspy", "numba", "dask", "distributed"),
}

needs_installation = pytest.mark.skipif(
    "DENSIFY_TEST_INSTALLED" not in os.environ,
    reason="DENSIFY_TEST_INSTALLED is not set: these tests may run on the checkout",
)


def modules_after(code: str, cwd: Path | None = None) -> set[str]:
    """Top-level modules that a fresh interpreter holds after the code."""
    code += "\nimport json, sys; print('\\n' + json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=cwd
    )
    return {name.partition(".")[0] for name in json.loads(done.stdout.splitlines()[-1])}


def test_imports_and_help_are_light() -> None:
    """The package, the version, and the help of every command."""
    commands = "run compare dataset flow train labels info doctor simulate export report evaluate"
    code = (
        "import densify, densify.config\n"
        "from densify.cli import main\n"
        f"for command in ['--version', '--help'] + {commands.split()} + ['bench', 'bench flow']:\n"
        "    try:\n        main([*command.split(), '--help'])\n"
        "    except SystemExit as end:\n        assert end.code == 0\n"
        "else:\n    print()"
    )
    assert not HEAVY & modules_after(code)


def test_the_default_run_waits_for_no_torch() -> None:
    """Nor for other packages that take longer to import than a stage to run."""
    code = (
        "from tests.small_street import KEY, POSES_GIVEN, one_car\n"
        "import densify\n"
        "result = densify.run(one_car(), KEY, 1, config=POSES_GIVEN)\n"
        "assert result.cloud.moving.any()"
    )
    # KISS-ICP compares the given poses with odometry
    assert not {"torch", "dask", "matplotlib"} & modules_after(code, CHECKOUT)


def test_public_names_exist() -> None:
    for name in [name for name in dir(densify) if not name.startswith("_")]:
        assert getattr(densify, name).__name__ == name
    with pytest.raises(AttributeError, match="no attribute 'densfy'"):
        _ = densify.densfy


@needs_installation
def test_the_installed_package_is_tested() -> None:
    assert version("densify-lidar") == densify.__version__
    assert f"## {densify.__version__}" in (CHECKOUT / "CHANGES.md").read_text("utf-8")
    scripts = [e for e in entry_points(group="console_scripts") if e.name == "densify"]
    assert scripts and scripts[0].value == "densify.cli:script"
    home = Path(densify.__file__).resolve().parent
    assert CHECKOUT not in home.parents, f"{home} is the checkout, not an installed package"
    for path in (CHECKOUT / "configs").glob("*.yaml"):
        assert presets()[path.stem].parent == home / "configs"
        assert presets()[path.stem].read_bytes() == path.read_bytes()
    package = CHECKOUT / "densify"
    sources = {path.relative_to(package) for path in CODE}
    sources |= {p.relative_to(package) for p in (package / "outputs" / "page").iterdir()}
    sources |= {path.relative_to(package) for path in package.rglob("*.txt")}
    missing = sorted(str(path) for path in sources if not (home / path).is_file())
    assert not missing


def test_links_of_pages_lead_somewhere() -> None:
    for page, text in PAGES.items():
        for link in re.findall(r"\]\(([^)#]+)", text):
            assert link.startswith("https://") or (page.parent / link).exists(), f"{page}: {link}"


def test_messages_and_pages_name_what_can_be_installed() -> None:
    """``densify`` on the package index is another project."""
    extras = set(re.findall(r"^(\w+) = \[", (CHECKOUT / "pyproject.toml").read_text(), re.M))
    code, texts = "".join(CODE.values()), "".join((*CODE.values(), *PAGES.values()))
    named = re.findall(r'(?:import_extra\("[\w.]+", |how_to_install\()["\'](\w+)', code)
    assert not re.search(r"pip install '?densify\b(?!-lidar)", texts)
    named += re.findall(r"pip install '(?:densify-lidar|\.)\[([\w,]+)\]'", texts)
    assert len(named) > 15 and {e for names in named for e in names.split(",")} <= extras


def test_the_pages_name_knobs_that_exist() -> None:
    text = "".join(PAGES.values())
    knobs = re.findall(r"`(?:--set )?([a-z]+\.[a-z_]+)(=[^`]+)?`", text)
    sections = as_mapping(Config())
    named = [(*name.split("."), value) for name, value in knobs if name.split(".")[0] in sections]
    assert len(named) >= 4
    for section, key, value in named:
        default = sections[section][key]
        said = "null" if default is None else default
        resolve(None, [f"{section}.{key}{value or f'={said}'}"])


BANNED = {
    # As SECURITY.md promises; where pickle may be used, `DOORS` says
    "running code of a file": (
        r"\b(eval|exec)\(|allow_pickle=True|(unsafe|full)_load|yaml\.(Unsafe|Full)?Loader\b"
        r"|torch\.load|shell=True|os\.system|\b(marshal|shelve|subprocess|cloudpickle|dill)\b"
    ),
    "exit, print or assert in a library": r"(?m)^\s*(print\(|assert |sys\.exit|raise SystemExit)",
}


@pytest.mark.parametrize("case", BANNED)
def test_what_no_code_does(case: str) -> None:
    for path, text in CODE.items():
        if case.startswith("exit") and ("cli" in path.parts or path.name == "__main__.py"):
            continue
        match = re.search(BANNED[case], text)
        assert not match, f"{path}: {match and match.group()[:80]}"


FLOORS = (
    ("version",),
    ("config",),
    ("geometry",),
    ("free_space",),
    ("registration", "depth", "flow", "scores", "street"),
    ("readers",),
    ("outputs",),
    ("pipeline",),
    ("learning",),
    ("bench", "dataset", "doctor"),
    ("cli",),
)
"""A module imports from lower floors only, or from its own."""


def test_no_arrow_runs_upward() -> None:
    floor = {room: height for height, rooms in enumerate(FLOORS) for room in rooms}
    package = CHECKOUT / "densify"
    rooms = {p.stem for p in package.iterdir() if p.suffix == ".py" or (p / "__init__.py").exists()}
    assert rooms - {"__init__", "__main__"} == set(floor)
    rows = re.findall(r"^\| (`densify/.*?) \|", (CHECKOUT / "CONTRIBUTING.md").read_text(), re.M)
    named = {name.removeprefix("densify/") for row in rows for name in re.findall("`(.*?)`", row)}
    assert named == {path.parent.name for path in package.glob("*/__init__.py")}
    for path, text in CODE.items():
        room = path.relative_to(package).parts[0].removesuffix(".py")
        if room in floor:
            used = re.findall(r"^\s*from densify\.(\w+)", text, re.MULTILINE)
            for other in used:
                assert floor[other] <= floor[room], f"{path} imports densify.{other}"


DOORS: dict[str, str | tuple[str, ...]] = {
    "dask": "densify/dataset/executor.py",
    "distributed": "densify/dataset/executor.py",
    "foxglove": "densify/outputs/viewers.py",
    "rerun": "densify/outputs/viewers.py",
    "open3d": "densify/outputs/viewers.py",
    "matplotlib": "densify/outputs/plots.py",
    "embreex": "densify/street/world.py",
    "kiss_icp": "densify/registration/odometry.py",
    "laspy": ("densify/readers/decoded_files.py", "densify/outputs/cloud_files.py"),
    "numba": ("densify/geometry/compiled.py",),
    "pickle": ("densify/readers/decoded_files.py",),
    "simplejpeg": "densify/readers/decoded_files.py",
    "small_gicp": "densify/registration/odometry.py",
    "torch": ("densify/flow/", "densify/dataset/loader.py", "densify/learning/"),
}


@pytest.mark.parametrize("package", DOORS)
def test_heavy_packages_have_few_doors(package: str) -> None:
    for path, text in CODE.items():
        where = path.relative_to(CHECKOUT).as_posix()
        imports = re.search(rf"^\s*(import|from) {package}\b", text, re.MULTILINE)
        assert not imports or where.startswith(DOORS[package]), where
