# SPDX-License-Identifier: MIT
"""Damaged and hostile files, wherever files of others are read: they are taken, or refused in one
line."""

from __future__ import annotations

import gzip
import io
import json
import os
import re
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import cv2
import laspy
import numpy as np
import pytest
from writers import FORMATS

from densify.cli.recordings import read_points
from densify.config import resolve
from densify.config.errors import ComputationError, InputError
from densify.config.file_content import gunzip, read_bytes, read_json
from densify.dataset.plan import read_plan
from densify.geometry.types import Camera
from densify.outputs.cloud_files import read_cloud
from densify.readers import Spec, describe, open_sequence
from densify.readers.decoded_files import read_array, read_arrays, read_image
from densify.readers.flow_files import load_flow_file
from densify.readers.kitti_files import read_labels, read_stamps
from densify.readers.point_files import read_table
from densify.readers.prior_files import PriorFiles
from densify.readers.recorded_poses import PoseFile
from densify.readers.stamped_files import StampFile
from densify.readers.street import Street

NUM_FILE_CASES = int(os.environ.get("DENSIFY_TEST_CASES", "40"))
NUM_TREE_CASES = 1 + NUM_FILE_CASES // 40
REFUSED = (InputError, ComputationError)

# --- changes of files -----------------------------------------------------------------------------

NUMBERS = (
    *("0", "-1", "255", "65536", "4294967296", "9223372036854775807", "99999999999999999999"),
    *("1e9", "1e308", "1e999", "1e-320", "nan", "inf", "0x10", "", "1" * 400),
)
WORDS = (
    *(b"", b"\0", b"\n", b" ", b"#", b": ", b"[", b'"', b"&a", b"*a", b"!!python/object:os.system"),
    *(b"\xff", b"../..", b"x" * 300, b"[" * 2000, b"null"),
)
FLOATS = (0.0, -1.0, 1e30, float("nan"), float("inf"))
VALUES: tuple[Any, ...] = (
    *(None, True, -1, 0, 2**63, 10**30, 0.5, 1e308, float("nan"), "", "x" * 300, "\0", [], {}),
    [[[1]]],
)
NUMBER = re.compile(rb"[-+]?\d+(\.\d+)?(e[-+]?\d+)?")


def mutated(rng: Random, data: bytes) -> bytes:
    """Change a file in one to three places, headers more often than the rest; packed content and
    JSON also inside."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        inside = next((f for start, f in INSIDE.items() if data.startswith(start)), None)
        if inside and rng.random() < 0.6:
            try:
                data = inside(rng, data)
            except Exception:  # it was changed before
                data = data[: len(data) // 2]
        else:
            at = rng.randrange(max(1, min(512, len(data)) if rng.random() < 0.6 else len(data)))
            number = NUMBER.search(data, at) if rng.random() < 0.2 else None
            begin, end = number.span() if number else (at, at)
            data = data[:begin] + rng.choice(CHANGES)(rng, data[end:])
    return data


def overwrite(make: Callable[[Random], bytes]) -> Callable[[Random, bytes], bytes]:
    def change(rng: Random, rest: bytes) -> bytes:
        new = make(rng)
        return new + rest[len(new) * rng.randrange(2) :]

    return change


CHANGES: tuple[Callable[[Random, bytes], bytes], ...] = (
    lambda rng, rest: b"",  # cut off
    lambda rng, rest: rest[: rng.choice((1, 4, 100))] * rng.choice((0, 2, 50)) + rest,
    overwrite(lambda rng: bytes([rng.randrange(256)])),
    overwrite(lambda rng: struct.pack(rng.choice("<>") + rng.choice("fd"), rng.choice(FLOATS))),
    overwrite(lambda rng: rng.choice((0, 1, 255, -1)).to_bytes(rng.choice((2, 4, 8)), signed=True)),
    overwrite(lambda rng: rng.choice(WORDS)),
    overwrite(lambda rng: rng.choice(NUMBERS).encode()),
)


def in_json(rng: Random, data: bytes) -> bytes:
    """Put another value in place of one."""
    values = [*re.finditer(rb'"[^"]*"|[-\d.]+|null|true', data)]
    if not values:
        return data[:-1]
    begin, end = rng.choice(values).span()
    return data[:begin] + json.dumps(rng.choice(VALUES)).encode() + data[end:]


def in_zip(rng: Random, data: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(buffer, "w") as changed:
        chosen = rng.choice(archive.namelist())
        for name in archive.namelist():
            content = archive.read(name)
            changed.writestr(name, mutated(rng, content) if name == chosen else content)
    return buffer.getvalue()


def in_gzip(rng: Random, data: bytes) -> bytes:
    return gzip.compress(mutated(rng, gzip.decompress(data)), 1)


INSIDE = {b"{": in_json, b"[": in_json, b"PK": in_zip, b"\x1f\x8b": in_gzip}


def check(use: Callable[[], Any], what: str) -> None:
    """It works, or is refused in one line."""
    try:
        use()
    except REFUSED as error:
        said = str(error)
        assert "\n" not in said and 0 < len(said) <= 1000, f"{what}: {said!r}"
    except Exception as error:
        raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error


# --- files ----------------------------------------------------------------------------------------

rng = np.random.default_rng(0)
IMAGE = cv2.GaussianBlur(rng.integers(0, 255, (8, 12, 3), np.uint8), (3, 3), 0)
DEEP = rng.integers(0, 60_000, (8, 12), np.uint16)
POINTS = rng.normal(0, 20, (40, 4)).astype("<f4")
ROWS = "\n".join(" ".join(f"{v:.3f}" for v in row) for row in POINTS)
PCD = """VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 40
HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA """
PLY = "ply\nformat ascii 1.0\nelement vertex 40\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "intensity")
)
CONFIGS = Path(__file__).parents[1] / "configs"
LABEL = "0 1 Car 0 0 -1.5 296 161 455 292 2.0 1.8 4.4 -4.5 1.8 13.4 -2.1\n"


def saved(save: Callable[..., None], *arrays: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arrays, **named)
    return buffer.getvalue()


def las(compressed: bool) -> bytes:
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, 0.001)
    kinds = {"int32": "frame instance", "uint8": "moving far", "float32": "confidence displaced"}
    extra = [(name, kind) for kind, names in kinds.items() for name in names.split()]
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in extra])
    cloud, buffer = laspy.LasData(header), io.BytesIO()
    cloud.xyz = POINTS[:, :3]
    cloud.write(buffer, do_compress=compressed)
    return buffer.getvalue()


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def read_prior(path: Path) -> None:
    camera = Camera("cam", 12, 8, np.eye(3), np.eye(4))
    PriorFiles.open(path, ["cam"]).prior(camera, 5)


def read_spec(path: Path) -> None:
    spec = Spec.parse(os.fsdecode(path.read_bytes()))
    if spec.reader == "street":
        Street.from_spec(spec.place)


ARRAYS = {"points": POINTS[:, :3], "offset_ns": np.arange(40), "lidar": np.zeros(40, np.uint8)}
FLOW = {"row": np.arange(40), "residual_flow": POINTS[:, :3], "moving": POINTS[:, 3] > 0}
STAMPS = "".join(f"2011-09-26 13:10:{n:02d}.158069617\n" for n in range(9))
TIMES = "# frame time\n" + "".join(f"{n} {1.3e9 + n / 10:.9f}\n" for n in range(9))
KITTI_POSES = "".join(f"1 0 0 {n} 0 1 0 0 0 0 1 0\n" for n in range(5))
TUM_POSES = "".join(f"{1.3e9 + n / 10:.3f} {n} 0 0 0 0 0 1\n" for n in range(5))
FILES: dict[str, tuple[tuple[Callable[[Path], Any], ...], bytes]] = {
    "a.png": ((read_image,), encoded(".png", IMAGE)),
    "b.png": ((lambda path: read_image(path, as_stored=True),), encoded(".png", DEEP)),
    "a.jpg": ((read_image,), encoded(".jpg", IMAGE)),
    "a.npy": ((read_array, read_table), saved(np.save, POINTS)),
    "a.npz": ((read_arrays, read_table, read_points), saved(np.savez_compressed, **ARRAYS)),
    "a.bin": ((read_table,), POINTS.tobytes()),
    "a.txt": ((read_table,), ROWS.encode()),
    "a.csv": ((read_table,), b"x,y,z,i\n" + ROWS.replace(" ", ",").encode()),
    "a.pcd": ((read_table,), f"{PCD}ascii\n{ROWS}".encode()),
    "b.pcd": ((read_table,), f"{PCD}binary\n".encode() + POINTS.tobytes()),
    "a.ply": ((read_table,), f"{PLY}end_header\n{ROWS}\n".encode()),
    "a.las": ((read_table,), las(compressed=False)),
    "a.laz": ((read_table, read_cloud), las(compressed=True)),
    "000001_000002.npz": ((load_flow_file,), saved(np.savez_compressed, **FLOW)),
    "5.npy": ((read_prior,), saved(np.save, DEEP.astype(np.float32))),
    "5.png": ((read_prior,), encoded(".png", DEEP)),
    "a.json": ((read_json,), b'{"a": [1, 2.5, null, {"b": "c"}], "d": {"e": true}}'),
    "default.yaml": ((resolve,), (CONFIGS / "default.yaml").read_bytes()),
    "override": ((lambda path: resolve(None, [os.fsdecode(path.read_bytes())]),), b"project.at=x"),
    "spec": ((read_spec,), b"street:crossing?seed=7&sensor=vlp16&hz=20&tilt=10&cameras=fast"),
    "stamps.txt": ((StampFile.read, read_stamps), STAMPS.encode()),
    "times.txt": ((StampFile.read,), TIMES.encode()),
    "kitti.txt": ((PoseFile.read,), KITTI_POSES.encode()),
    "tum.txt": ((PoseFile.read,), TUM_POSES.encode()),
    "labels.txt": ((read_labels,), LABEL.encode() * 3),
    "a.gz": ((lambda path: gunzip(read_bytes(path), path),), gzip.compress(b"a" * 99)),
    "dataset.json": ((lambda p: read_plan(p.parent),), b'{"schema_version": 1, "drives": {}}'),
}


@pytest.mark.parametrize("name", FILES)
def test_files(name: str, tmp_path: Path) -> None:
    path, (readers, content) = tmp_path / name, FILES[name]
    for number in range(NUM_FILE_CASES):
        changed = mutated(Random(f"{name} {number}"), content)
        path.write_bytes(changed)
        for read in readers:
            check(lambda read=read: read(path), f"{name} {changed[:2000]!r}")


# --- recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.filterwarnings("ignore")
def test_recordings(format: str, copied, tmp_path: Path) -> None:
    """One file of a recording is changed at a time."""
    place = copied(format)
    files = sorted(path for path in tmp_path.rglob("*") if path.is_file())
    for number in range(NUM_TREE_CASES):
        random = Random(f"{format} {number}")
        path = random.choice(files)
        content = path.read_bytes()
        path.write_bytes(mutated(random, content))
        read_all(place, f"{path}, number {number}")
        path.write_bytes(content)


def read_all(place: Path, what: str) -> None:
    try:
        sequence = open_sequence(place)
    except REFUSED as error:
        assert "\n" not in str(error), what
        return
    check(lambda: describe(sequence), what)
    for frame in list(sequence.frames)[:4]:
        check(lambda frame=frame: sequence[frame], what)
        check(lambda frame=frame: sequence.T_world_lidar(frame), what)
        if hasattr(sequence, "boxes"):
            check(lambda frame=frame: sequence.boxes(frame), what)
    for camera in sequence.cameras:
        for image in list(sequence.image_stamps_ns(camera))[:2]:
            check(lambda camera=camera, image=image: sequence.image(camera, image), what)
