# SPDX-License-Identifier: MIT
"""A street written in the format of each reader, once for all tests of a process."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from writers import write_street
from writers.excerpt import Excerpt

from densify.readers.street import Street

FRAMES, CAMERA = (59, 60, 61), "image_02"
STREETS = {  # sensor, rate, frames, cameras; of the others as of None
    None: ("vlp16", 10, FRAMES, (CAMERA,)),
    "nuscenes": ("hdl32", 20, (119, 120, 121), (CAMERA,)),
    "waymo": ("vlp16", 10, FRAMES, (CAMERA, "rolling")),
}


@cache
def excerpt_of(format: str | None = None) -> Excerpt:
    """What is written in a format."""
    sensor, hz, frames, cameras = STREETS.get(format, STREETS[None])
    return Excerpt.of(Street("street", 0, sensor, hz=hz, cameras=cameras), frames, None)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Gives the place of the street in a format."""

    @cache
    def place(format: str) -> Path:
        excerpt = excerpt_of(format)
        return write_street(
            format, excerpt.street, tmp_path_factory.mktemp(format) / "val", excerpt.frames
        )

    return place


@pytest.fixture(scope="module")
def excerpt(request: pytest.FixtureRequest) -> Excerpt:
    """Of the module's FORMAT, as the next two."""
    return excerpt_of(getattr(request.module, "FORMAT", None))


@pytest.fixture(scope="module")
def written(request: pytest.FixtureRequest, recorded: Callable[[str], Path]) -> Path:
    return recorded(request.module.FORMAT)


@pytest.fixture
def broken(request: pytest.FixtureRequest, copied: Callable[[str], Path]) -> Path:
    """A copy to be changed."""
    return copied(request.module.FORMAT)


@pytest.fixture
def copied(recorded: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """Makes a copy to be damaged, without its truth."""

    def copy(format: str) -> Path:
        place = recorded(format)
        (root,) = (folder for folder in (place, *place.parents) if folder.name == "val")
        shutil.copytree(root, tmp_path / "val", ignore=shutil.ignore_patterns("truth"))
        return tmp_path / "val" / place.relative_to(root)

    return copy
