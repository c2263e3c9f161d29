# SPDX-License-Identifier: MIT
"""Every file of others comes in by a door that bounds what it may cost and says what is wrong in
one line."""

from __future__ import annotations

import errno
import io
import json
import os
import pickle
import re
import struct
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.config import file_content as content
from densify.config import resolve
from densify.config.errors import ComputationError, InputError, OutputError, UnplacedSweepError
from densify.config.file_content import gunzipped, read_bytes
from densify.config.text_files import parse_json, parse_yaml
from densify.readers.array_files import read_array, read_arrays
from densify.readers.image_files import decode_image
from densify.readers.kitti.files import Stamps
from densify.readers.kitti.odometry import _read_times_ns
from densify.readers.stamp_files import StampFile, named

CHECKOUT = Path(__file__).parents[1]


def refused(call, *arguments, says: str, where: str | Path | None = None, **options) -> None:
    with pytest.raises(InputError, match=says) as caught:
        call(*arguments, **options)
    line = str(caught.value)
    assert line.startswith(str(arguments[0] if where is None else where)) and "\n" not in line
    assert len(line) <= 1000


class TestContent:
    def test_pipes_and_folders_are_not_waited_for(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe")
        for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
            refused(read_bytes, path, says="no file but a folder, pipe or device")

    @pytest.mark.parametrize(
        ("number", "failures", "reads"),
        [(errno.EIO, 1, 2), (errno.EIO, 2, 3), (errno.EIO, 9, 3), (errno.EPERM, 1, 1)],
    )
    def test_what_disks_recover_from_is_tried_again(
        self, number: int, failures: int, reads: int, tmp_path: Path, monkeypatch
    ) -> None:
        """Half of it had been read before."""
        path, calls = tmp_path / "a", []
        path.write_bytes(b"0123456789")

        class Failing(io.BytesIO):
            def fileno(self) -> int:
                return number_of

            def read(self, size: int = -1) -> bytes:
                calls.append(size)
                if len(calls) <= failures:
                    super().read(5)
                    raise OSError(number, os.strerror(number))
                return super().read(size)

        with path.open("rb") as real:
            number_of = real.fileno()
            monkeypatch.setattr(content, "open_file", lambda _: Failing(b"0123456789"))
            monkeypatch.setattr(content, "_PAUSES_S", (0.0, 0.0))
            if failures < reads:
                assert read_bytes(path) == b"0123456789"
            else:
                refused(read_bytes, path, says=os.strerror(number))
        assert len(calls) == reads

    def test_a_file_is_no_larger_than_that(self, tmp_path: Path) -> None:
        path = tmp_path / "sparse"
        path.touch()
        os.truncate(path, 1 << 40)
        refused(read_bytes, path, says=r"holds 1,099,511,627,776 bytes .* 1,073,741,824 at most")

    @pytest.mark.parametrize("name", ["x" * 300, "a\0b", "nothing"])
    def test_names_that_cannot_be(self, name: str, tmp_path: Path) -> None:
        refused(read_bytes, tmp_path / name, says="cannot be read: ", where=tmp_path)

    def test_a_gzip_bomb_is_not_unpacked(self) -> None:
        pack = zlib.compressobj(9, zlib.DEFLATED, 31)
        bomb = pack.compress(bytes(1 << 20)) + pack.flush()
        assert gunzipped(bomb, "x", 1 << 20) == bytes(1 << 20)
        refused(gunzipped, bomb, "x", (1 << 20) - 1, says="1,048,575 at most", where="x")
        refused(gunzipped, bomb[:-20], "x", says="not a whole gzip", where="x")


def npy(shape: str = "(3,)", descr: str = "'<f8'", data: bytes = bytes(24)) -> bytes:
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


BAD_NPY = {
    "claims 10^12 rows": npy("(1000000000000, 3)"),
    "claims more than there are numbers": npy("(10**12,)"),
    "claims rows without bytes": npy("(1000000000000,)", "'|V0'"),
    "claims negative rows": npy("(-1,)"),
    "cut off": npy(data=bytes(23)),
    "objects": npy("(1,)", "'|O'"),
    "brackets": npy("(" * 3000),
    "no array": b"\x93NUMPY\x09\x00 what",
    "empty": b"",
}


class TestArrays:
    def test_what_numpy_writes_comes_back(self, tmp_path: Path) -> None:
        arrays = {
            "a": np.arange(12.0).reshape(3, 4),
            "columns": np.asfortranarray(np.arange(12, dtype="<i2").reshape(3, 4)),
            "one": np.array(3.0),
            "none": np.zeros((0, 3), np.float32),
            "words": np.array(["x", "yy"]),
            "named": np.array([(1, 2.0)], [("n", "<i4"), ("x", "<f8")]),
        }
        np.savez_compressed(tmp_path / "a.npz", **arrays)
        found = read_arrays(tmp_path / "a.npz")
        assert found.keys() == arrays.keys()
        for name, array in arrays.items():
            np.save(tmp_path / "a.npy", array)
            for back in (found[name], read_array(tmp_path / "a.npy")):
                assert back.dtype == array.dtype and np.array_equal(back, array)
                assert back.flags.writeable and back.flags.f_contiguous == array.flags.f_contiguous
        assert list(read_arrays(tmp_path / "a.npz", ("one", "other"))) == ["one"]

    @pytest.mark.parametrize("case", BAD_NPY)
    def test_headers_are_not_believed(self, case: str, tmp_path: Path) -> None:
        alone, inside = tmp_path / "a.npy", tmp_path / "a.npz"
        alone.write_bytes(BAD_NPY[case])
        refused(read_array, alone, says="not a whole .npy file: .")
        with zipfile.ZipFile(inside, "w") as archive:
            archive.writestr("points.npy", BAD_NPY[case])
        refused(read_arrays, inside, says="not a readable .npz file: .")

    def test_a_zip_bomb_is_not_unpacked(self, tmp_path: Path) -> None:
        path = tmp_path / "a.npz"
        np.savez_compressed(path, a=np.zeros(1 << 17), b=np.zeros(1 << 17))
        refused(read_arrays, path, most_bytes=1 << 20, says="expected 1,048,576 at most")
        assert len(read_arrays(path, ("a",), most_bytes=(1 << 20) + 128)) == 1

    def test_a_member_that_says_it_is_small_is_read_no_further(self, tmp_path: Path) -> None:
        path = tmp_path / "a.npz"
        np.savez_compressed(path, a=np.zeros(1 << 17))
        size = (128 + 8 * (1 << 17)).to_bytes(4, "little")
        path.write_bytes(path.read_bytes().replace(size, (200).to_bytes(4, "little")))
        refused(read_arrays, path, says="not a readable .npz file: .")

    def test_members_that_are_no_arrays_are_passed_over(self, tmp_path: Path) -> None:
        with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
            archive.writestr("README", b"text")
            archive.writestr("a.npy", npy())
        assert list(read_arrays(tmp_path / "a.npz")) == ["a"]

    def test_each_takes_its_own_kind(self, tmp_path: Path) -> None:
        np.savez(tmp_path / "a.npz", a=np.zeros(3))
        (tmp_path / "b.npy").write_bytes((tmp_path / "a.npz").read_bytes())
        refused(read_array, tmp_path / "b.npy", says="name it .npz")
        (tmp_path / "b.npz").write_bytes(npy())
        refused(read_arrays, tmp_path / "b.npz", says="name it .npy")


IMAGE = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


def encoded(suffix: str, *options: int) -> bytes:
    return cv2.imencode(suffix, IMAGE, options)[1].tobytes()


def part(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


class TestImages:
    @pytest.mark.parametrize(
        "data",
        [
            encoded(".png"),
            encoded(".jpg"),
            encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
            encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2),
        ],
        ids=["png", "jpeg", "progressive", "restarts"],
    )
    def test_whole_ones_are_decoded_and_cut_ones_are_not(self, data, capfd) -> None:
        """libpng writes to stderr itself, and libjpeg fills what is missing with gray."""
        expected = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert np.array_equal(decode_image(data, "x"), expected)
        for length in (0, 1, 10, 30, len(data) // 2, len(data) - 13, len(data) - 2):
            refused(decode_image, data[:length], "x", says="not a complete image", where="x")
        assert capfd.readouterr() == ("", "")

    def test_sizes_are_looked_at_before_anything_is_decoded(self, capfd) -> None:
        data = encoded(".png")
        large = part(b"IHDR", struct.pack(">II", 100_000, 100_000) + data[24:29])
        refused(
            decode_image,
            data[:8] + large + data[33:],
            "x",
            says="got an image of 100000 x 100000 px, expected 134,217,728 pixels at most",
            where="x",
        )
        data = bytearray(encoded(".jpg"))
        at = data.index(b"\xff\xc0")
        data[at + 5 : at + 9] = b"\xff\xff\xff\xff"
        refused(decode_image, bytes(data), "x", says="65535 x 65535 px", where="x")
        assert capfd.readouterr() == ("", "")

    def test_what_is_no_part_of_the_image_is_passed_over(self, capfd) -> None:
        data = encoded(".png")
        profile = part(b"iCCP", b"bad\0\0" + zlib.compress(b"no profile"))
        assert np.array_equal(decode_image(data[:33] + profile + data[33:], "x"), IMAGE)
        assert capfd.readouterr() == ("", "")

    def test_damaged_jpegs_are_refused_in_our_own_words(self, capfd) -> None:
        """opencv decodes them to wrong colours, with a line of libjpeg's on stderr."""
        data, refusals = encoded(".jpg", cv2.IMWRITE_JPEG_RST_INTERVAL, 2), 0
        for at in range(data.index(b"\xff\xda") + 14, len(data) - 2, 7):
            changed = data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]
            try:
                decode_image(changed, "x")
            except InputError as error:
                refusals += "x: a damaged JPEG image (" in str(error)
        assert refusals > 20
        assert capfd.readouterr() == ("", "")

    @pytest.mark.parametrize("suffix", [".bmp", ".tiff", ".webp"])
    def test_other_formats_are_not_decoded(self, suffix: str) -> None:
        refused(decode_image, encoded(suffix), "x", says="expected a PNG or JPEG", where="x")


LEVELS = [
    f"&{b} [{', '.join(['*' + a] * 10)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
]
BOMB = f"{{project: {{support: [&a [1,1,1,1,1,1,1,1,1,1], {', '.join(LEVELS)}]}}}}"


class TestTexts:
    @pytest.mark.parametrize(
        "value",
        ["!!int ''", "!!float ''", "!!timestamp x", "!!bool x", "!!map [a]", "!!set [a]",
         "!!python/object:os.system x", "[" * 3000, "{a: " * 3000, "{[a]: b}", "2001-99-99",
         "&a [*a]", "\x07", "!!binary x"],
    )  # fmt: skip
    def test_yaml_that_is_none(self, value: str) -> None:
        refused(parse_yaml, value, "x", says="not YAML|an alias to what it is in", where="x")
        with pytest.raises(InputError, match=r"--set project\.support=") as caught:
            resolve(None, [f"project.support={value}"])
        assert len(str(caught.value)) <= 1000 and "\n" not in str(caught.value)

    def test_an_alias_bomb_is_counted_first(self, tmp_path: Path) -> None:
        (tmp_path / "a.yaml").write_text(BOMB)
        refused(resolve, tmp_path / "a.yaml", says="100,000 values at most", where=tmp_path)

    def test_lines_and_keys_given_twice(self) -> None:
        assert parse_yaml("a:\n  b: 1\n  c: [1, 2]\n", "x") == (
            {"a": {"b": 1, "c": [1, 2]}},
            {"a": 1, "a.b": 2, "a.c": 3},
        )
        assert parse_yaml("# nothing\n", "x") == (None, {})
        refused(parse_yaml, "a:\n  b: 1\n  b: 2\n", "x", says="line 3: a.b is given", where="x")

    @pytest.mark.parametrize("data", [b"[" * 100_000, b"{", b"\xff", b"1" * 5000, b""])
    def test_json_that_is_none(self, data: bytes) -> None:
        refused(parse_json, data, "x", says="not a whole JSON file", where="x")


@pytest.mark.parametrize("year", ["9999", "2262", "1969"])
def test_stamps_of_years_that_64_bits_cannot_say(year: str, tmp_path: Path) -> None:
    """numpy makes other years of them, without a word."""
    path = tmp_path / "timestamps.txt"
    path.write_text(f"2011-09-26 13:10:51.158069617\n{year}-09-26 13:10:51.158069617\n")
    refused(StampFile.read, path, says=rf"line 2: got '{year}.* from 1970 to 2261")
    stamps = Stamps.read(path)
    assert stamps is not None and stamps.get(0) is not None
    refused(stamps.__getitem__, 1, says=rf"got '{year}.* from 1970 to 2261, on line 2", where=path)


@pytest.mark.parametrize("time", ["1e999999999", "1e999000", "inf", "nan", "9" * 400])
def test_times_that_are_none(time: str, tmp_path: Path) -> None:
    """Some of them are minutes of work as whole numbers."""
    path = tmp_path / "times.txt"
    path.write_text(f"0\n0.1\n{time}\n")
    refused(StampFile.read, path, says="expected times|no finite numbers")
    refused(StampFile.read, path, "s", says="line 3: got .* expected a time in s")
    refused(_read_times_ns, path, says=r"line 3: got .*(expected a time in s|beyond the year 2262)")


@pytest.mark.parametrize("name", ["9999999999_000000000", "1" * 200, "1" * 20 + "." + "2" * 20])
def test_names_that_are_no_times(name: str) -> None:
    assert named(Path(f"{name}.bin")).stamp_ns is None
    assert named(Path(f"{name}.bin"), "s").stamp_ns is None or len(name) == 20


@pytest.mark.parametrize("data", [b"1" * 5000, b'{"a": [' + b"9" * 400 + b"]}"])
def test_json_numbers_that_no_float_holds(data: bytes) -> None:
    refused(parse_json, data, "x", says="not a whole JSON file .*number of", where="x")


@pytest.mark.parametrize(
    "change",
    [{"frames": [[0, 10**10]]}, {"frames": [[0, 10**30]]}, {"cameras": None}, {"data": 3}],
    ids=str,
)
def test_descriptions_of_sets_are_not_believed(change, tmp_path: Path) -> None:
    from densify.dataset.plan import _SAME, SCHEMA_VERSION, read_plan

    drive = {"data": "street", "folder": "street", "frames": [[0, 5]], "cameras": {}} | change
    table = {"schema_version": SCHEMA_VERSION, **dict.fromkeys(_SAME)} | {"config": {}, "gate": {}}
    path = tmp_path / "dataset.json"
    for bad in (
        {**table, "drives": {"a": drive}},
        {**table, "drives": {}, "config": None},
        {**table, "drives": {"a": None}},
        [table],
    ):
        path.write_text(json.dumps(bad))
        refused(read_plan, tmp_path, says="damaged or no description of a training set")
    for bad, told in (({}, "it has no schema_version"), ([table], "it holds no mapping")):
        path.write_text(json.dumps(bad))
        refused(read_plan, tmp_path, says=told)


def test_scores_of_other_kinds_are_not_averaged(tmp_path: Path) -> None:
    from key_records import record

    from densify.dataset.make import status

    lines = [
        record(0, scores={"density": {"left": 0.25}}),
        record(1, scores={"density": {"left": "high"}}),
        record(2, scores={"density": {"left": {"deep": [1]}}}),
        record(3, scores={"density": "high"}),
        record(4, scores={"density": [0.5]}),
    ]
    (tmp_path / "manifest.jsonl").write_bytes(b"".join(line.to_line() for line in lines))
    table = {"schema_version": 1, "config": {}, "gate": {}}
    drive = {"data": "street", "folder": "a", "frames": [[0, 4]], "cameras": {}}
    same = ("densify", "layout", "method", "window", "cameras")
    (tmp_path / "dataset.json").write_text(
        json.dumps({**dict.fromkeys(same), **table, "drives": {lines[0].drive: drive}})
    )
    assert status(tmp_path)[0].mean("density") == 0.25


@pytest.mark.parametrize("kind", [InputError, OutputError, ComputationError])
def test_messages_echo_no_more_than_a_line(kind: type[Exception]) -> None:
    word, quoted, listed = "x" * 5000, f"'{'a b ' * 5000}'", str([*range(20_000)])
    for got in (word, quoted, listed):
        line = str(kind(f"/a/path: got {got}, expected a number"))
        assert len(line) <= 1000
        assert line.startswith("/a/path: got ") and line.endswith(", expected a number")
        assert "..." in line
    told = f"the sensor's file: {'one, ' * 50}or the car's"  # two apostrophes quote nothing
    assert str(kind(told)) == told
    path = "/" + "p" * 250
    assert str(kind(f"{path}: is 'as it is'")) == f"{path}: is 'as it is'"
    error = pickle.loads(pickle.dumps(UnplacedSweepError("y" * 400, 3)))
    assert error.frame == 3 and len(str(error)) == 200


UNGUARDED = (
    r"np\.load\(|np\.fromfile|cv2\.imread\(|imdecode|\.read_bytes\(|\.read_text\(|json\.load"
    r"|yaml\.(safe_)?(load|compose)\(|gzip\.(open|decompress)\(|zipfile\.ZipFile|\.open\(\"rb\"\)|mmap_mode"
)
OTHER_PLACES = {
    "cache/__init__.py": "the package's own source",
    "cache/codec.py": "behind a check sum, bounded there",
    "dataset/make.py": "its own log files",
    "dataset/plan.py": "what it has made itself",
    "dataset/processes.py": "/proc",
    "dataset/work.py": "what it has just written",
    "outputs/atomic.py": "/proc",
    "outputs/kitti_tree.py": "text of a README",
    "process/costs.py": "/proc",
    "process/memory.py": "/proc, /sys",
    "readers/nuscenes/tables.py": "single records, bounded there",
    "report/film.py": "what it made itself",
    "report/page_file.py": "the package's own page",
    "writers/kitti_raw.py": "what it writes itself",
}


def test_there_are_no_other_doors() -> None:
    package = CHECKOUT / "densify"
    for path in package.rglob("*.py"):
        name = path.relative_to(package).as_posix()
        if name in OTHER_PLACES or name.startswith("files/"):
            continue
        found = re.search(UNGUARDED, path.read_text("utf-8"))
        assert not found, f"{name}: {found and found.group()}: by densify.config"
