# SPDX-License-Identifier: MIT
"""`dataset --links`: loaders of others find the set and its images."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from tests.command import exit_code, refused
from tests.dataset_scenes import DRIVE, OPTIONS, in_order, maps_in

ARGUMENTS = (*OPTIONS, "--method", "none", "--keys", "39:41")
DEPTH = "data_depth_velodyne/{split}/*_sync/proj_depth/velodyne_raw/image_0[2,3]/*.png"
TRUTH = "data_depth_annotated/{split}/*_sync/proj_depth/groundtruth/image_0[2,3]/*.png"
# Where they look for the image of data_depth_annotated/val/DRIVE/proj_depth/groundtruth/CAMERA/NAME
LOADERS = {
    "fangchangma/self-supervised-depth-completion": "{split}/{drive}/{camera}/data/{name}",
    "JUGGHM/PENet_ICRA2021": "{date}/{drive}/{camera}/data/{name}",
}


@pytest.fixture
def linked(border_drive: Path, tmp_path: Path) -> Path:
    out = tmp_path / "set"
    command = ("dataset", "--data", border_drive, *ARGUMENTS, "--links", "--out", out)
    assert exit_code(*command) == 0
    return out


@pytest.mark.parametrize("loader", LOADERS)
def test_a_loader_finds_everything(loader: str, linked: Path, border_drive: Path) -> None:
    split = "val"  # the drive is one of KITTI's for validation
    depth, truth = (sorted(linked.glob(p.format(split=split))) for p in (DEPTH, TRUTH))
    assert len(depth) == len(truth) == 2
    for sparse, dense in zip(depth, truth, strict=True):
        assert (sparse.name, sparse.parent.name) == (dense.name, dense.parent.name)
        drive, camera = dense.parts[-5], dense.parts[-2]
        places = {"split": split, "date": drive[:10], "drive": drive, "camera": camera}
        image = linked / "data_rgb" / LOADERS[loader].format(**places, name=dense.name)
        assert image.read_bytes() == (border_drive / camera / "data" / dense.name).read_bytes()


def test_links_are_no_part_of_the_set(linked: Path, border_drive: Path) -> None:
    """And are made again where they are missing, the right ones left alone."""
    in_order(linked)
    before = maps_in(linked)
    shutil.rmtree(linked / "data_rgb")
    command = ("dataset", "--data", border_drive, *ARGUMENTS, "--links", "--out", linked)
    assert exit_code(*command) == 0
    assert (linked / "data_rgb" / "val" / DRIVE / "image_02").is_dir()
    assert maps_in(linked) == before
    assert os.readlink(linked / "data_depth_velodyne" / "val") == "../val"  # the set may be moved


def test_what_stands_in_the_way_stays(linked: Path, border_drive: Path, capsys) -> None:
    place = linked / "data_rgb" / "val" / DRIVE
    place.unlink()
    place.mkdir()
    (place / "mine").touch()
    command = ("dataset", "--data", border_drive, *ARGUMENTS, "--links", "--out", linked)
    capsys.readouterr()
    assert exit_code(*command) == 2
    assert f"--links: {place} is there already" in capsys.readouterr().err
    assert (place / "mine").exists()


def test_only_in_the_tree(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "set"
    command = ("dataset", "--data", border_drive, "--layout", "densify", "--links", "--out", out)
    assert "--links: of --layout kitti-depth" in refused(capsys, 2, *command)
    assert not out.exists()
