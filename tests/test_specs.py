# SPDX-License-Identifier: MIT
"""What ``--data`` names: readers, places, scenes, and the same recording from another folder."""

from __future__ import annotations

from pathlib import Path

import pytest

import densify
from densify.config.errors import InputError
from densify.dataset.plan import Recipe, plan
from densify.readers import Spec
from tests.dataset_scenes import DRIVE, FRAMES


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("street", ("street", "street", None)),
        ("street:highway?seed=2", ("street", "street:highway?seed=2", None)),
        ("street?sensor=vlp16", ("street", "street?sensor=vlp16", None)),
        ("streets/first", (None, "streets/first", None)),
        ("./street", (None, "./street", None)),
        ("kitti:here/0013", ("kitti", "here/0013", None)),
        ("kitti:here#scene-7", ("kitti", "here", "scene-7")),
        ("kitti:a#b#c", ("kitti", "a#b", "c")),
        ("here#there", (None, "here#there", None)),
        ("kit:here", (None, "kit:here", None)),
    ],
)
def test_parts_of_a_spec(text: str, parts: tuple, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert Spec.parse(text) == parts
    absolute = Spec.parse(text).absolute()
    assert Spec.parse(absolute).absolute() == absolute
    if parts[0] == "street":
        assert absolute == text
    else:
        assert Spec.parse(absolute).path == tmp_path / parts[1]


def test_a_folder_with_a_number_sign(tmp_path: Path) -> None:
    (tmp_path / "run#3").mkdir()
    assert Spec.parse(f"kitti:{tmp_path}/run#3") == ("kitti", f"{tmp_path}/run#3", None)
    assert Spec.parse(f"kitti:{tmp_path}/run#3#4") == ("kitti", f"{tmp_path}/run#3", "4")


def test_a_scene_of_a_place_whose_reader_is_guessed(border_drive: Path) -> None:
    parts = (None, f"{border_drive}", "night")
    assert Spec.parse(f"{border_drive}#night") == parts
    assert Spec.parse(Spec.parse(f"{border_drive}#night").absolute()) == parts
    with pytest.raises(InputError, match="kitti recordings have no scenes; leave #night out"):
        densify.open_sequence(f"{border_drive}#night")


def test_a_set_of_a_recording_with_its_reader(border_drive: Path, monkeypatch) -> None:
    """The processes that make it, and those that read it, may work in other folders."""
    monkeypatch.chdir(border_drive.parent)
    (planned,) = plan([f"kitti:{DRIVE}"], None, Recipe())
    (as_path,) = plan([str(border_drive)], None, Recipe())
    assert planned.data == f"kitti:{border_drive}"
    assert planned.folder == as_path.folder == f"val/{DRIVE}"
    assert planned.keys == as_path.keys == tuple(FRAMES)
