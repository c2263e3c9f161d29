# SPDX-License-Identifier: MIT
"""Files of a set that changed on the disk: found by their hashes, and made anew."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import densify
from densify.config.errors import InputError
from tests.command import exit_code, files_in
from tests.dataset_scenes import OPTIONS, in_order, maps_in


@pytest.fixture
def damaged_set(border_set: Path, tmp_path: Path) -> tuple[Path, list[str]]:
    """A set with one file of the right size and wrong bytes, and the names of the file and of one
    that is gone."""
    out = tmp_path / "set"
    shutil.copytree(border_set, out)
    names = sorted(n for n in maps_in(out) if "/groundtruth/" in n)[:2]
    data = (out / names[0]).read_bytes()
    (out / names[0]).write_bytes(data[:-20] + bytes(20))
    (out / names[1]).unlink()
    return out, names


def test_status_lists_what_is_damaged(damaged_set, capsys) -> None:
    out, names = damaged_set
    assert exit_code("dataset", "--status", out) == 0  # looks at no content
    before = files_in(out)
    capsys.readouterr()
    assert exit_code("dataset", "--status", out, "--verify") == 1
    captured = capsys.readouterr()
    told = [line for line in captured.out.splitlines() if line.startswith("damaged: ")]
    assert told == [f"damaged: {name}" for name in names]
    assert "2 damaged or missing files" in captured.err and "--verify" in captured.err
    assert files_in(out) == before


def test_a_whole_set_is_verified(border_set: Path, capsys) -> None:
    assert exit_code("dataset", "--status", border_set, "--verify") == 0
    assert "damaged" not in capsys.readouterr().out


def test_run_again_it_makes_them_anew(damaged_set, border_set: Path, border_drive: Path) -> None:
    out, names = damaged_set
    again = ["dataset", "--data", border_drive, *OPTIONS, "--out", out]
    assert exit_code(*again) == 0
    assert maps_in(out).keys() == maps_in(border_set).keys()
    assert maps_in(out)[names[0]] != maps_in(border_set)[names[0]]  # of the right size: kept
    with pytest.raises(InputError, match=f"{Path(names[0]).name}.*again with --verify") as caught:
        [sample for sample in densify.DepthDataset(out)]
    assert "\n" not in str(caught.value)
    assert exit_code(*again, "--verify") == 0
    assert maps_in(out) == maps_in(border_set)
    in_order(out)
