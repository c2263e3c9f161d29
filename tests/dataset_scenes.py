# SPDX-License-Identifier: MIT
"""Small recordings, in memory and as a KITTI raw drive, and the sets that are made of them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

import densify
from densify.dataset.manifest import damaged_files, read_manifests
from tests.command import files_in
from tests.scenes import (
    CAMERA,
    Arc,
    Scanner,
    Scene,
    TinySequence,
    World,
    car,
    stamp_ns,
    street,
)

BORDER = 40
FRAMES = range(BORDER - 4, BORDER + 5)
COARSE = Scanner(24, 360)
DRIVE = "2011_09_26_drive_0013_sync"
"""One of KITTI's for validation."""


def across_border(
    frames: Sequence[int] = FRAMES, scanner: Scanner = COARSE, movers: bool = True
) -> TinySequence:
    """At frame `BORDER` the vehicle is at the start of a street, at 4 m/s, behind a car at 8 m/s.
    Another car comes towards it at 7 m/s."""
    cars = car(9 - 8 * 4, 1.8, 8, 1), car(22 + 7 * 4, 2.3, 7, 2, np.pi)
    world = World((*street(50.0), *(cars if movers else ())))
    return TinySequence(Scene(world, Arc(-4 * 4, -1.5, 0, 4.0), scanner), frames)


def write_drive(sequence: TinySequence, date: Path, drive: str = DRIVE) -> Path:
    """The sweeps and one camera, ``image_02``, as a KITTI raw drive; returns its folder."""
    folder, T, size_px = date / drive, CAMERA.T_cam_lidar, (CAMERA.width_px, CAMERA.height_px)
    P = np.column_stack([CAMERA.K, np.zeros(3)])
    texts = {
        date / "calib_cam_to_cam.txt": f"R_rect_00: {_words(np.eye(3))}\n"
        f"S_rect_02: {size_px[0]} {size_px[1]}\nP_rect_02: {_words(P)}\n",
        date / "calib_velo_to_cam.txt": f"R: {_words(T[:3, :3])}\nT: {_words(T[:3, 3])}\n",
        date / "calib_imu_to_velo.txt": f"R: {_words(np.eye(3))}\nT: 0 0 0\n",
        folder / "oxts" / "timestamps.txt": _stamps(sequence.frames, 0),
    }
    for name, late_ns in (("", 0), ("_start", -50_000_000), ("_end", 50_000_000)):
        path = folder / "velodyne_points" / f"timestamps{name}.txt"
        texts[path] = _stamps(sequence.frames, late_ns)
    for frame in sequence.frames:
        texts[folder / "oxts" / "data" / f"{frame:010d}.txt"] = _oxts(sequence, frame)
        write_sweep(sequence, folder, frame)
        path = folder / "image_02" / "data" / f"{frame:010d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((*size_px[::-1], 3), 128, np.uint8))
    for path, text in texts.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def _oxts(sequence: TinySequence, frame: int) -> str:
    """Of a vehicle that drives straight on to the east, at the equator."""
    T = sequence.T_world_lidar(frame)
    assert np.allclose(T[:3, :3], np.eye(3))
    lon, lat = np.rad2deg(T[:2, 3] / 6_378_137)
    return f"{lat:.17g} {lon:.17g} {T[2, 3]:.17g}" + 27 * " 0" + "\n"


def _stamps(frames: Sequence[int], late_ns: int) -> str:
    """Of all frames up to the last."""
    stamps = (np.datetime64(stamp_ns(f) + late_ns, "ns") for f in range(max(frames) + 1))
    return "\n".join(str(stamp).replace("T", " ") for stamp in stamps) + "\n"


def _words(array: np.ndarray) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(array))


def write_sweep(sequence: TinySequence, drive: Path, frame: int) -> None:
    sweep, path = sequence[frame], sweep_file(drive, frame)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(np.column_stack([sweep.points, sweep.intensity]).astype("<f4").tobytes())


def sweep_file(drive: Path, frame: int) -> Path:
    return drive / "velodyne_points" / "data" / f"{frame:010d}.bin"


# The drives' images are of one colour, of which rims would be told only with a warning.
OPTIONS = (
    *("--window", "2", "--set", "register.source=dataset"),
    *("--set", "project.rims=strict"),
)


def maps_in(out: Path) -> dict[str, bytes]:
    """What a set holds for training: path relative to it -> bytes."""
    return {name: data for name, data in files_in(out).items() if name.endswith(".png")}


def records(out: Path) -> list[dict]:
    """Of all manifests, as they stand in the files."""
    lines = [x for p in sorted(out.glob("manifest*.jsonl")) for x in p.read_text().splitlines()]
    return [json.loads(line) for line in lines]


def statuses(out: Path) -> dict[int, str]:
    return {record["key"]: record["status"] for record in records(out)}


def keys_of(names: Iterable[str]) -> set[int]:
    return {int(Path(name).stem) for name in names}


def in_order(out: Path) -> None:
    """Nothing is left over, every file is as recorded, and no file is not."""
    names, by_key = files_in(out), read_manifests(out)
    assert not [n for n in names if n.endswith((".tmp", ".old"))]
    assert all(n.startswith(".manifest") for n in names if n.startswith("."))
    recorded: set[str] = set().union(*(record.files for record in by_key.values()))
    assert not [name for record in by_key.values() for name in damaged_files(record, out)]
    about = ("dataset.json", "README.txt", "report.html", "manifest", "densify", ".")
    assert {name for name in names if not name.startswith(about)} == recorded
    assert len(records(out)) == len(by_key)


def story(out: Path) -> list[dict]:
    """The manifests without the seconds."""
    by_key = sorted(records(out), key=lambda r: (r["drive"], r["key"]))
    return [{k: v for k, v in r.items() if k != "seconds"} for r in by_key]


def copy_drive(drive: Path, to: Path) -> Path:
    """With the calibration beside it; returns the copy's folder."""
    shutil.copytree(drive.parent, to)
    return to / drive.name


def command(*arguments: str | Path, **environment: str) -> subprocess.Popen[str]:
    """``densify dataset`` as a process in a session of its own."""
    home = str(Path(densify.__file__).parents[1])
    return subprocess.Popen(
        [sys.executable, "-m", "densify", "dataset", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": home, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
