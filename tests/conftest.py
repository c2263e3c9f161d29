# SPDX-License-Identifier: MIT
"""Shared by all tests and by the processes that run them: the cores, a cache, and the real data
where there is some.

The files of tests are spread over processes, one for each core (pyproject.toml); ``pytest -n0``
runs all in one.
"""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

from densify.dataset.executor import share_of_cores

NUM_PROCESSES = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
if NUM_PROCESSES > 1:  # libraries read it when imported: the tests' own modules come after it
    os.environ.update(share_of_cores(NUM_PROCESSES))

from tests.command import exit_code  # noqa: E402
from tests.dataset_scenes import OPTIONS, across_border, write_drive  # noqa: E402
from tests.recorded import broken, copied, excerpt, recorded, written  # noqa: E402, F401

# No test depends on how busy the machine is.
hypothesis.settings.register_profile("densify", deadline=None)
hypothesis.settings.load_profile("densify")


LONGEST = (
    *("examples", "street", "fuzz", "gate", "dataset", "recording", "learning_training"),
    *("bench", "registration", "pipeline", "far", "executor", "cli"),
    *("doctor", "report", "groups", "labels"),
    *("bench_paper", "reader_data_sets", "flow_sets"),
)
"""Files of tests that take long begin, so that no process works on one while the others wait at the
end. While the first file compiles every inner loop, the next two simulate and compile none: two
processes would compile the same."""


def pytest_configure() -> None:
    """Steps that earlier code left in a given cache are made again; their versions stay the same
    while somebody works on them."""
    if "PYTEST_XDIST_WORKER" not in os.environ and "DENSIFY_CACHE_DIR" in os.environ:
        shutil.rmtree(Path(os.environ["DENSIFY_CACHE_DIR"]) / "steps", ignore_errors=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    place = {f"test_{name}.py": number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.name, len(place)))


def pytest_collection_finish() -> None:
    """What is imported stays: benches of memory collect garbage before each of their methods, and
    need not go through all of it again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Simulated sweeps go to a folder of this test session, never to the user's cache.

    All processes share it, so that a sweep is rendered once. Delete a folder given by
    DENSIFY_CACHE_DIR when the street changes.
    """
    with pytest.MonkeyPatch.context() as patch:
        if "DENSIFY_CACHE_DIR" not in os.environ:
            temporary = tmp_path_factory.getbasetemp()
            session = temporary.parent if NUM_PROCESSES > 1 else temporary
            patch.setenv("DENSIFY_CACHE_DIR", str(session / "cache"))
        yield Path(os.environ["DENSIFY_CACHE_DIR"])


@pytest.fixture(scope="session")
def border_drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine sweeps around the border of two blocks, as a KITTI raw drive."""
    return write_drive(across_border(), tmp_path_factory.mktemp("raw") / "2011_09_26")


@pytest.fixture(scope="session")
def border_set(border_drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The training set of it, made undisturbed by one process."""
    out = tmp_path_factory.mktemp("sets") / "whole"
    assert exit_code("dataset", "--data", border_drive, *OPTIONS, "--out", out) == 0
    return out


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """For one test."""
    cache = tmp_path / "cache"
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(cache))
    return cache


class RealData:
    """The folder of real recordings: ``test_data / "kitti/2011_09_26"`` is that path in it, or ends
    the test as skipped."""

    def __truediv__(self, name: str) -> Path:
        folder = os.environ.get("DENSIFY_TEST_DATA")
        if not folder:
            pytest.skip("DENSIFY_TEST_DATA is not set: no real recordings to test on")
        path = Path(folder) / name
        if not path.exists():
            pytest.skip(f"{path} is not there")
        return path


@pytest.fixture(scope="session")
def test_data() -> RealData:
    return RealData()


@pytest.fixture(scope="session")
def short_drive(test_data: RealData, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five sweeps of a real drive around frame 120, with all of their images."""
    whole = test_data / "kitti/2011_09_26/2011_09_26_drive_0013_sync"
    drive = tmp_path_factory.mktemp("real") / whole.parent.name / whole.name
    (drive / "velodyne_points/data").mkdir(parents=True)
    sweeps = [whole / f"velodyne_points/data/{frame:010d}.bin" for frame in range(118, 123)]
    calibration, stamps = whole.parent.glob("*.txt"), whole.glob("velodyne_points/*.txt")
    for path in (*calibration, whole / "image_02", whole / "oxts", *stamps, *sweeps):
        (drive.parent / path.relative_to(whole.parent)).symlink_to(path)
    return drive
