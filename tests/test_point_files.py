# SPDX-License-Identifier: MIT
"""Files of points: every format holds the same points, and is refused in a line when damaged."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from pypcd4 import Encoding, PointCloud

from densify.config.errors import InputError
from densify.readers import open_sequence
from densify.readers.point_files import read_table

rng = np.random.default_rng(5)
POINTS = np.round(rng.uniform(-40, 40, (60, 3)), 3).astype("<f4")
INTENSITY = rng.integers(0, 256, 60).astype("u1")
TIME = np.arange(60, dtype="<u4") * 1_700_000
RECORD = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "u1"), ("t", "<u4")])
ROWS = np.rec.fromarrays([*POINTS.T, INTENSITY, TIME], dtype=RECORD)

PADDED_HEADER = b"""# .PCD v0.7
VERSION 0.7
FIELDS x y z _ intensity t _ noise _
SIZE 4 4 4 1 1 4 1 2 1
TYPE F F F U U U U U U
COUNT 1 1 1 4 1 1 0 1 3
WIDTH 60
HEIGHT 1
VIEWPOINT 1 2 3 0.5 -0.5 0.5 -0.5
POINTS 60
DATA """
PADDED = np.dtype([("head", "V12"), ("a", "V4"), ("i", "u1"), ("t", "<u4"), ("b", "V5")])


def pcd(data: str) -> bytes:
    """As Ouster's driver writes it: padding between the fields, one of none."""
    rows = np.zeros(60, PADDED)
    rows["head"] = np.frombuffer(POINTS.tobytes(), "V12")
    rows["i"], rows["t"] = INTENSITY, TIME
    rows["a"], rows["b"] = b"\xff" * 4, b"\x01" * 5
    words = [f"{x} {y} {z} 7 7 7 7 {i} {t} 9 3 3 3 " for x, y, z, i, t in ROWS.tolist()]
    body = "\r\n".join(words).encode() if data == "ascii" else rows.tobytes()
    return PADDED_HEADER + f"{data}\n".encode() + body


def write_packed(path: Path) -> None:
    columns, types = zip(*((ROWS[n], RECORD[n].type) for n in RECORD.names), strict=True)
    PointCloud.from_points(columns, RECORD.names, types).save(path, Encoding.BINARY_COMPRESSED)


def write_ply(path: Path, **form: Any) -> None:
    vertex = PlyElement.describe(ROWS.view(np.ndarray), "vertex")
    faces = np.zeros(0, [("vertex_indices", "i4", (3,))])
    PlyData([vertex, PlyElement.describe(faces, "face")], **form).write(path)


def write_las(path: Path) -> None:
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.scales = [0.001] * 3
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = POINTS.T.astype(float)
    cloud.intensity, cloud.gps_time = INTENSITY, TIME * 1e-9
    cloud.write(path)


def write_text(path: Path, header: str, delimiter: str) -> None:
    np.savetxt(path, np.array(ROWS.tolist()), "%.9g", delimiter, header=header, comments="")


WRITERS = {
    "padded.pcd": lambda p: p.write_bytes(pcd("binary")),
    "words.pcd": lambda p: p.write_bytes(pcd("ascii")),
    "marked.pcd": lambda p: p.write_bytes(b"\xef\xbb\xbf" + pcd("ascii")),
    "packed.pcd": write_packed,
    "words.ply": lambda p: write_ply(p, text=True),
    "little.ply": lambda p: write_ply(p, byte_order="<"),
    "big.ply": lambda p: write_ply(p, byte_order=">"),
    "one.las": write_las,
    "one.laz": write_las,
    "comma.csv": lambda p: write_text(p, "x,y,z,intensity,t", ","),
    "quoted.csv": lambda p: write_text(p, '"x";"y";"z";"intensity";"t"', ";"),
    "blank.txt": lambda p: write_text(p, "# x y z intensity t", " "),
    "records.npy": lambda p: np.save(p, ROWS),
    "organised.npz": lambda p: np.savez(p, points=ROWS.reshape(6, 10)),
    "arrays.npz": lambda p: np.savez(p, **{name: ROWS[name] for name in RECORD.names}),
}


@pytest.mark.parametrize("name", WRITERS)
def test_formats_with_names_agree(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    if path.suffix == ".ply":
        pytest.importorskip("trimesh")
    WRITERS[name](path)
    columns = read_table(path)
    read = np.stack([columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(read, POINTS, atol=0.0006 if "one" in name else 0)
    np.testing.assert_array_equal(columns["intensity"], INTENSITY)
    time = columns["gps_time"] * 1e9 if "one" in name else columns["t"]
    np.testing.assert_allclose(time, TIME, rtol=1e-8)
    if path.suffix == ".pcd":
        assert columns.keys() == {*RECORD.names, *["noise"] * (name != "packed.pcd")}
        assert columns["t"].dtype == np.uint32 and read.dtype == np.float32


@pytest.mark.parametrize("name", ["rows.npy", "image.npy", "rows.txt", "rows.csv", "rows.bin"])
def test_columns_without_names_are_named_in_order(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    table = np.column_stack([POINTS, INTENSITY, np.arange(60)]).astype("<f4")
    if path.suffix == ".npy":
        np.save(path, table.reshape(6, 10, 5) if name == "image.npy" else table)
    elif path.suffix == ".bin":
        table.tofile(path)
    else:
        np.savetxt(path, table, "%.9g", "," if path.suffix == ".csv" else " ")
    names = ("x", "y", "z", "reflectance", "ring")
    columns = read_table(path, names)
    assert tuple(columns) == names
    np.testing.assert_allclose(np.stack([*columns.values()], axis=1), table, rtol=1e-7)
    with pytest.raises(InputError, match=r"expected 7: x y z|multiple of 28"):
        read_table(path, (*names, "sixth", "seventh"))
    if path.suffix != ".bin":
        assert tuple(read_table(path)) == ("x", "y", "z", "intensity", "column4")


def cut(num_bytes: int) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes()[:-num_bytes])


def swap(old: bytes, new: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(path.read_bytes().replace(old, new, 1))


DAMAGE = [
    ("padded.pcd", cut(26), "59 points, expected 60"),
    ("packed.pcd", cut(40), "not a readable .pcd"),
    ("packed.pcd", cut(10**4), "header ends before"),
    ("padded.pcd", swap(b"SIZE", b"SIDE"), "has no SIZE"),
    ("padded.pcd", swap(b"F F F U", b"F F F"), "8 TYPE"),
    ("words.ply", cut(200), "fewer than the 60 vertices"),
    ("words.ply", swap(b"element vertex", b"element corner"), "no 'vertex'"),
    ("one.laz", cut(300), "not a readable .laz"),
    ("comma.csv", swap(b"\n", b"\n1,2,x,4,5\n"), ".csv"),
    ("comma.csv", lambda p: p.write_text("x,y,z\n"), "holds no points"),
    ("arrays.npz", lambda p: np.savez(p, x=np.ones(3), y=np.ones(3), z=np.ones(2)), "other shapes"),
    ("records.npy", lambda p: np.save(p, np.zeros((4, 3000))), "expected numbers of shape (N,3)"),
    ("records.npy", lambda p: np.save(p, np.zeros((4, 64, 1024))), "shape (4, 64, 1024)"),
    ("records.npy", lambda p: np.save(p, np.array([{}]), allow_pickle=True), "allow_pickle=False"),
    (
        "comma.csv",
        lambda p: p.write_text("x,y,z\n1,2,3\n", "utf-16"),
        "is text in UTF-16, expected",
    ),
    ("comma.csv", lambda p: p.write_text("x,y,z\n1,2,3\n", "utf-16-le"), "is text in UTF-16, exp"),
]


@pytest.mark.parametrize(("name", "harm", "says"), DAMAGE, ids=range(len(DAMAGE)))
def test_damaged_files_are_refused_in_a_line(name: str, harm, says: str, tmp_path: Path) -> None:
    if name.endswith(".ply"):
        pytest.importorskip("trimesh")
    path = tmp_path / name
    WRITERS[name](path)
    harm(path)
    with pytest.raises(InputError) as error:
        read_table(path)
    line = str(error.value)
    assert line.startswith(str(path)) and "\n" not in line and says in line, line


@pytest.mark.parametrize(
    "text",
    [
        "\ufeffx,y,z\r\n1,2,3\r\n4,,6\r\n",
        "# made by hand\nx,y,z\n1,2,3\n4, ,6\n",
        "# x,y,z\n1,2,3\n\n4,nan,6\n",
        "x;y;z\n1;2;3\n4;;6\n",
        "X\tY\tZ\n1.0\t2.0\t3.0\n4.0\t\t6.0\n",
        '"x","y","z"\n1,2,3\n4,,6',
    ],
)
def test_tables_of_every_habit(text: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes(text.encode())
    columns = {name.lower(): c for name, c in read_table(tmp_path / "a.csv").items()}
    assert np.array_equal(columns["x"], [1, 4]) and np.array_equal(columns["z"], [3, 6])
    assert columns["y"][0] == 2 and np.isnan(columns["y"][1])


def ring(num_columns: int) -> np.ndarray:
    """A wall around the scanner, and columns that count."""
    angle, count = np.linspace(0, 6, 2520), np.arange(2520.0)
    points = [12 * np.cos(angle), 12 * np.sin(angle), np.full(2520, -1.7)]
    return np.column_stack([*points, *(count % (k + 1) for k in range(num_columns - 3))])


def no_rings(num_points: int = 2520) -> np.ndarray:
    return (ring(5)[:num_points] * [1, 1, 1, 1, 0.3]).astype("<f4")


# a time within the sweep, and the number of the scanner
SIX = np.column_stack([ring(4), np.linspace(0, 0.1, 2520), np.zeros(2520)]).astype("<f4")
ALIKE = 3 + np.random.default_rng(0).integers(0, 2, (400, 5)).astype("<f4")
OTHER_BYTES = {
    "doubles": (ring(4).astype("<f8"), "not alike; "),
    "big-endian": (ring(4).astype(">f4"), "not alike; "),
    "text": (np.frombuffer(b"not a scan. " * 4000, "u1"), "not alike; "),
    "5 columns": (no_rings(), "not alike; "),
    "6 columns": (SIX, ""),
    "alike however they are read": (ALIKE, "fits 4 and 5 float32 columns alike; "),
}


@pytest.mark.parametrize("kind", OTHER_BYTES)
def test_a_scan_of_other_bytes_is_not_guessed(kind: str, tmp_path: Path) -> None:
    rows, says = OTHER_BYTES[kind]
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(InputError, match=says + r".*densify\.yaml .*sweeps: {columns: "):
        read_table(tmp_path / "a.bin")


@pytest.mark.parametrize("num_points", [2519, 2520])  # rows of 4 do not fit, or fit
def test_the_error_of_five_columns_holds_the_setting_that_reads_them(
    num_points: int, tmp_path: Path
) -> None:
    (tmp_path / "lidar").mkdir()
    no_rings(num_points).tofile(tmp_path / "lidar" / "000000.bin")
    with pytest.raises(InputError) as error:
        open_sequence(f"folder:{tmp_path}")[0]
    setting = re.search(r"sweeps: \{.*\}", str(error.value))
    assert setting is not None and "\n" not in str(error.value), error.value
    (tmp_path / "densify.yaml").write_text(setting.group())
    sweep = open_sequence(f"folder:{tmp_path}")[0]
    np.testing.assert_array_equal(sweep.points, no_rings(num_points)[:, :3])


def test_columns_of_nuscenes_are_recognised(test_data: Path) -> None:
    (path,) = (test_data / "nuscenes/samples/LIDAR_TOP").iterdir()
    columns = read_table(path)
    assert list(columns) == ["x", "y", "z", "intensity", "ring"]
    rows = np.fromfile(path, "<f4").reshape(-1, 5)
    np.testing.assert_array_equal(np.column_stack([*columns.values()]), rows)


@pytest.mark.parametrize("num_points", [2517, 2518, 2519, 2520])
@pytest.mark.parametrize("num_columns", [4, 5, 6])
def test_as_many_columns_as_size_and_values_say(
    num_columns: int, num_points: int, tmp_path: Path
) -> None:
    names = ["x", "y", "z", "intensity", "ring"][:num_columns]
    rows, rng = ring(6)[:num_points], np.random.default_rng(0)
    rows[:, 3] = rng.uniform(0, 300, num_points)
    if num_columns == 6:
        names[4:] = "elongation", "timestamp"  # of the frame, in microseconds
        rows[:, 4], rows[:, 5] = rng.uniform(0, 1.5, num_points), 1_550_083_467_346_370
    rows = rows[:, :num_columns].astype("<f4")
    rows.tofile(tmp_path / "a.bin")
    columns = read_table(tmp_path / "a.bin")
    assert list(columns) == names
    np.testing.assert_array_equal(np.column_stack([*columns.values()]), rows)
