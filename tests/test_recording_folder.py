# SPDX-License-Identifier: MIT
"""Results of two recordings never share a folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from densify.config.errors import InputError
from densify.dataset.plan import Recipe, plan, write_plan
from densify.outputs.finished_run import export_run
from densify.outputs.folders import (
    check_recording,
    default_folder,
    drive_folder,
    is_same,
    split_of,
)
from densify.readers.depth_trees import pair_depth_files
from tests.command import files_in, refused
from tests.dataset_scenes import DRIVE, copy_drive
from tests.exported import write_views

STREET = "street?sensor=vlp16"
VERBS = {
    "run": ["--key", "120", "--overwrite"],
    "compare": ["--key", "120", "--overwrite"],
    "flow": ["--all", "--overwrite"],
    "dataset": [],
}


def test_each_recording_has_its_folder() -> None:
    assert default_folder("street:street?seed=0&sensor=hdl64") == Path("densify-out/street")
    other = drive_folder("street:street?seed=1&sensor=hdl64")
    assert other == "street-street_seed-1_sensor-hdl64" and drive_folder(DRIVE) == DRIVE


def test_the_split_is_that_of_the_benchmark() -> None:
    official = {"2011_09_26": 9, "2011_09_28": 1, "2011_09_29": 1, "2011_09_30": 1, "2011_10_03": 1}
    for date, expected in official.items():
        splits = [split_of(f"{date}_drive_{number:04d}_sync") for number in range(200)]
        assert splits.count("val") == expected and splits.count("train") == 200 - expected
    assert split_of("2011_09_26_drive_0013_sync") == split_of("2011_10_03_drive_0047") == "val"
    for name in ("street:street?seed=0", "", "2011_09_26_drive_0013_synced", "drive_0013_sync"):
        assert split_of(name) == "train"


ODD_NAMES = ["", ".", "..", "../../etc", "a/b", "/", "-rf", ".hidden", "a b", "a  b", "ä", "å"]
ODD_NAMES += ["x" * 300, "x" * 301, "a\nb", "a\0b"]


@given(st.lists(st.text() | st.sampled_from(ODD_NAMES), unique=True, max_size=8))
def test_any_name_becomes_one_harmless_folder(names: list[str]) -> None:
    plain = [name for name in names if not set(name) & set(":?=&")]
    folders = [drive_folder(name) for name in plain]
    assert len(set(folders)) == len(folders)
    for folder in (*folders, *map(drive_folder, names)):
        assert folder.isascii() and len(folder) <= 100
        assert not set(folder) & set("/\\\0 \n\"'") and folder[0] not in ".-"
        assert drive_folder(folder) == folder


@pytest.mark.parametrize("verb", VERBS)
def test_a_folder_of_another_recording_is_refused(verb: str, tmp_path: Path, capsys) -> None:
    for stored in ("run.yaml", "compare.json", "dataset.json"):
        out = tmp_path / stored
        table = {"recording": DRIVE, "data": "/data/kitti"}
        path = out / "000007" / stored
        if stored == "dataset.json":
            path, table = out / stored, {"drives": {DRIVE: {"data": "/data/kitti"}}}
        path.parent.mkdir(parents=True)
        path.write_text(yaml.safe_dump(table) if stored == "run.yaml" else json.dumps(table))
        before = files_in(out)
        line = refused(capsys, 2, verb, STREET, *VERBS[verb], "--out", out)
        assert str(out) in line and files_in(out) == before
        if verb != "dataset":  # which takes no folder of runs at all
            assert DRIVE in line and "/data/kitti" in line and "another recording" in line


def test_flow_files_name_their_recording(tmp_path: Path, capsys) -> None:
    np.savez(tmp_path / "000001_000002.npz", recording=np.array("other"))
    line = refused(capsys, 2, "flow", STREET, "--all", "--overwrite", "--out", tmp_path)
    assert "000001_000002.npz is of another recording, other" in line


def test_which_recordings_are_the_same(tmp_path: Path) -> None:
    first, second = tmp_path / "a" / "drive", tmp_path / "b" / "drive"
    for folder in (first, second):
        (folder / "sweeps").mkdir(parents=True)
    for data in (first / "sweeps", f"folder:{first}", tmp_path / "moved" / "drive"):
        assert is_same("drive", str(first), "drive", str(data))
    assert not is_same("drive", str(first), "drive", str(second))
    assert not is_same("drive", str(first), "other", str(first))


def test_damaged_files_and_older_results_do_not_hinder(tmp_path: Path) -> None:
    for name, text in (("000001", "data: ["), ("000002", "data: street\nkey: 2\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.yaml").write_text(text)
    check_recording(tmp_path, "street", "street", [1, 2])
    check_recording(tmp_path / "new", "street", "street")


def test_a_set_goes_on_with_its_recording_alone(border_drive: Path, tmp_path: Path, capsys):
    out = tmp_path / "out"
    write_plan(out, Recipe(), plan([str(border_drive)], None, Recipe()))
    same = copy_drive(border_drive, tmp_path / "2011_09_26")
    line = refused(capsys, 2, "dataset", same, "--out", out)
    assert str(border_drive) in line and str(same) in line


def test_an_export_within_a_run_is_no_second_prediction(tmp_path: Path) -> None:
    run, _ = write_views(tmp_path, {"image_02": "plain"})
    export_run(run, "kitti")
    key = int(run.name)
    pairs = pair_depth_files(run.parent, run.parent)
    assert [pair.predicted for pair in pairs.pairs] == [run / "depth" / "image_02.png"]
    exported = run / "export" / "kitti"
    (pair,) = pair_depth_files(exported, exported).pairs
    assert pair.predicted.name == f"{key:010d}.png"


def test_a_set_of_maps_names_the_layout_that_exports(tmp_path: Path) -> None:
    (tmp_path / "dataset.json").write_text("{}")
    for to in ("npy", "kitti"):
        with pytest.raises(InputError, match="--layout densify to export it"):
            export_run(tmp_path, to)
