# SPDX-License-Identifier: MIT
"""`dataset --links`: loaders of others find the set and its images."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from tests.command import exit_code, refused
from tests.dataset_scenes import DRIVE, OPTIONS, in_order, maps_in

DEPTH = "data_depth_velodyne/val/*_sync/proj_depth/velodyne_raw/image_0[2,3]/*.png"
TRUTH = "data_depth_annotated/val/*_sync/proj_depth/groundtruth/image_0[2,3]/*.png"
# Where they look for the image of data_depth_annotated/val/DRIVE/proj_depth/groundtruth/CAMERA/NAME
LOADERS = {
    "fangchangma/self-supervised-depth-completion": "val/{drive}/{camera}/data/{name}",
    "JUGGHM/PENet_ICRA2021": "{date}/{drive}/{camera}/data/{name}",
}


def test_loaders_find_everything(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "set"
    command = ["dataset", "--data", border_drive, *OPTIONS, "--method", "none", "--keys", "39:41"]
    command += ["--links", "--out", out]
    assert exit_code(*command) == 0
    depth, truth = (sorted(out.glob(pattern)) for pattern in (DEPTH, TRUTH))
    assert len(depth) == len(truth) == 2
    for sparse, dense in zip(depth, truth, strict=True):
        assert (sparse.name, sparse.parent.name) == (dense.name, dense.parent.name)
        drive, camera = dense.parts[-5], dense.parts[-2]
        for place in LOADERS.values():
            named = place.format(date=drive[:10], drive=drive, camera=camera, name=dense.name)
            recorded = border_drive / camera / "data" / dense.name
            assert (out / "data_rgb" / named).read_bytes() == recorded.read_bytes()
    # Links are no part of the set, and are made again where they are missing.
    in_order(out)
    before = maps_in(out)
    shutil.rmtree(out / "data_rgb")
    assert exit_code(*command) == 0
    assert (out / "data_rgb" / "val" / DRIVE / "image_02").is_dir()
    assert maps_in(out) == before
    assert os.readlink(out / "data_depth_velodyne" / "val") == "../val"  # the set may be moved
    # What stands in the way stays.
    place = out / "data_rgb" / "val" / DRIVE
    place.unlink()
    place.mkdir()
    (place / "mine").touch()
    capsys.readouterr()
    assert exit_code(*command) == 2
    assert f"--links: {place} is there already" in capsys.readouterr().err
    assert (place / "mine").exists()


def test_only_in_the_tree(border_drive: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "set"
    command = ("dataset", "--data", border_drive, "--layout", "densify", "--links", "--out", out)
    assert "--links: of --layout kitti-depth" in refused(capsys, 2, *command)
    assert not out.exists()
