# SPDX-License-Identifier: MIT
"""Flow between two point files on the command line, and every way such a file can be broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from densify.cli.recordings import read_points
from tests.command import exit_code, refused


def test_flow_between_two_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-5, 5, (300, 3)) + np.array([20.0, 0, 0])
    np.save(tmp_path / "a.npy", points)
    np.savez(tmp_path / "b.npz", points=points)
    out = tmp_path / "deep" / "flow.npz"
    command = ["flow", str(tmp_path / "a.npy"), str(tmp_path / "b.npz"), "--out", str(out)]
    assert exit_code(*command) == 0
    captured = capsys.readouterr().out
    assert captured.splitlines() == ["300 points, 0 moving", str(out)]
    with np.load(out) as arrays:
        flow = arrays["residual_flow"]
        assert flow.shape == (300, 3) and flow.dtype == np.float32 and not flow.any()
        assert not arrays["moving"].any()
        assert arrays["instance"].tolist() == [-1] * 300
    before = out.read_bytes()
    assert "--overwrite" in refused(capsys, 2, *command)
    assert exit_code(*command, "--overwrite") == 0
    assert out.read_bytes() == before
    assert [path.name for path in out.parent.iterdir()] == ["flow.npz"]


@pytest.mark.parametrize(
    ("name", "content", "part"),
    [
        ("absent.npy", None, "No such file"),
        ("flat.npy", np.zeros(9), "shape (9,)"),
        ("none.npy", np.zeros((0, 3)), "holds no points"),
        ("nan.npy", np.array([[1, 2, 3], [1, np.nan, 3]]), "1 of 2 points are not finite"),
        ("objects.npy", np.array([[{}, {}, {}]], dtype=object), "Object arrays"),
        ("garbage.npz", b"no zip", "not a readable .npz"),
        ("cloud.stl", b"solid", "got .stl, expected one of .pcd, .bin, .ply"),
    ],
)
def test_bad_point_files(name, content, part, tmp_path: Path, capsys) -> None:
    np.save(tmp_path / "good.npy", np.ones((5, 3)))
    if isinstance(content, bytes):
        (tmp_path / name).write_bytes(content)
    elif content is not None:
        np.save(tmp_path / name, content, allow_pickle=True)
    out = tmp_path / "f.npz"
    line = refused(capsys, 2, "flow", tmp_path / "good.npy", tmp_path / name, "--out", out)
    assert name in line and part in line
    assert not out.exists()


def test_point_files_of_every_kind_agree(tmp_path: Path) -> None:
    wall = [[20.0, y / 8, -1.5, 0.25] for y in range(9)]
    points = np.array(wall, np.float32)
    np.save(tmp_path / "p.npy", points)
    np.savez(tmp_path / "p.npz", points=points)
    np.savetxt(tmp_path / "p.txt", points)
    points.tofile(tmp_path / "p.bin")
    for name in ("p.npy", "p.npz", "p.txt", "p.bin"):
        read = read_points(tmp_path / name)
        assert read.dtype == np.float64
        assert np.array_equal(read, points[:, :3])


@pytest.mark.parametrize("out", ["flow.txt", "folder.npz", "file/deep/flow.npz"])
def test_bad_place_for_the_flow(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], out: str
) -> None:
    np.save(tmp_path / "good.npy", np.ones((5, 3)))
    (tmp_path / "folder.npz").mkdir()
    (tmp_path / "file").write_text("")
    good = tmp_path / "good.npy"
    assert str(tmp_path / out) in refused(capsys, 2, "flow", good, good, "--out", tmp_path / out)
