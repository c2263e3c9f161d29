# SPDX-License-Identifier: MIT
"""Folders of no known form: a street written as one, files of every kind beside each other, drafts
of densify.yaml, and damage."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from writers import write_street
from writers.excerpt import Excerpt

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.outputs.simulated_street import config_text
from densify.readers import open_sequence
from densify.readers.describe import describe
from densify.readers.folder.config import FolderConfig
from densify.readers.folder.draft import draft_config
from densify.readers.folder.reader import Folder
from densify.readers.street import Street
from tests.reader_checks import check_cameras, check_depth, check_sweeps, check_truth
from tests.test_point_files import write_pcd

FRAMES, CAMERA = (59, 60, 61), "image_02"


@pytest.fixture(scope="module")
def excerpt():
    return Excerpt.of(Street("street", 0, "vlp16", cameras=(CAMERA,)), FRAMES, None)


@pytest.fixture(scope="module")
def written(excerpt, tmp_path_factory):
    return write_street("folder", excerpt.street, tmp_path_factory.mktemp("folder"), FRAMES)


@pytest.fixture
def broken(written, tmp_path):
    """A copy to be damaged."""
    return shutil.copytree(written, tmp_path / "tree", ignore=shutil.ignore_patterns("truth"))


def test_the_street_is_given_back(written, excerpt):
    sequence = open_sequence(written)
    assert isinstance(sequence, Folder)
    check_sweeps(sequence, excerpt, offset_ns=4)  # float32 seconds
    check_cameras(sequence, excerpt)
    check_truth(sequence, excerpt)


def test_depth_is_that_of_the_street(written, excerpt):
    check_depth(open_sequence(written), excerpt, worse=0.02)


def test_scanners_lenses_and_rolling_shutters_are_kept(tmp_path):
    street = Street("static", 0, "panda", cameras=("fisheye", "rolling"))
    config(tmp_path, config_text(Excerpt.of(street, [60], None)))
    read = FolderConfig.read(tmp_path)
    np.testing.assert_allclose(read.sweeps.scanner_origins, street.simulator.sensor.origins_m)
    assert read.sweeps.columns[-1] == "lidar"
    for name, (given, _) in read.cameras.items():
        camera = street.cameras[name]
        for key, value in vars(given).items():
            np.testing.assert_array_equal(value, getattr(camera, key))
    origins = "scanner_origins: [[0, 0, 0], [1, 0, -0.5]]"
    config(tmp_path, f"sweeps: {{columns: [x, y, z, lidar], {origins}}}\n")
    sweep = Folder(
        bare(tmp_path, ["0.bin"], lambda i: np.column_stack([scan(), np.arange(600) % 2]))
    )[0]
    np.testing.assert_array_equal(sweep.lidar, np.arange(600) % 2)
    np.testing.assert_array_equal(sweep.scanner_origins, [[0, 0, 0], [1, 0, -0.5]])


# Without densify.yaml


def scan(num=600, shift_m=0.0):
    """A ring on the ground and a wall, in the order of firing."""
    azimuth = np.linspace(-np.pi, np.pi, num, endpoint=False)
    wall = np.where(np.arange(num) // 50 % 2, 8.0, 12.0)
    return np.column_stack(
        [wall * np.cos(azimuth) - shift_m, wall * np.sin(azimuth), np.where(wall > 10, 1.0, -1.7)]
    ).astype("<f4")


def bare(folder: Path, names, make=lambda i: np.column_stack([scan(), np.full(600, 0.5, "<f4")])):
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        make(i).astype("<f4").tofile(folder / name)
    return folder


def test_numbered_files_alone_open(tmp_path):
    sequence = open_sequence(bare(tmp_path / "drive", ["000003.bin", "000004.bin", "000007.bin"]))
    assert list(sequence.frames) == [3, 4, 7] and not sequence.cameras
    assert [sequence.stamp_ns(f) for f in sequence.frames] == [3 * 10**8, 4 * 10**8, 7 * 10**8]
    sweep = sequence[4]
    np.testing.assert_array_equal(sweep.points, scan())
    assert sweep.offset_ns is None and set(sweep.intensity) == {0.5}
    assert re.search(r"^poses +none$", describe(sequence), re.M)
    with pytest.raises(InputError, match="no poses; let the sweeps register themselves"):
        sequence.T_world_lidar(3)
    text = describe(sequence)
    assert "assumed 10 Hz" in text and "intensity = intensity" in text


@pytest.mark.parametrize("suffix", ["npy", "csv", "txt"])
def test_numbered_tables_alone_open(suffix, tmp_path):
    for number in (3, 4):
        points = np.random.default_rng(number).uniform(-20, 20, (50, 4))
        if suffix == "npy":
            np.save(tmp_path / f"{number:06d}.npy", points)
        else:
            np.savetxt(tmp_path / f"{number:06d}.{suffix}", points, delimiter=",")
    (tmp_path / "timestamps.txt").write_text("0.0\n0.1\n")
    assert tuple(open_sequence(str(tmp_path)).frames) == (3, 4)
    (tmp_path / "notes.md").write_text("not sweeps alone")
    with pytest.raises(InputError, match="no known recording there"):
        open_sequence(str(tmp_path))


def test_pcd_files_open_with_times_and_viewpoints(tmp_path):
    for number in (1, 2):
        write_pcd(tmp_path / f"scan_{number:03d}.pcd", "binary")
    sequence = open_sequence(tmp_path)
    assert list(sequence.frames) == [1, 2]
    sweep = sequence[1]
    # t runs from 0 to 59 x 1.7 ms, in ns: a sweep of about 100 ms, whose rate it tells
    np.testing.assert_array_equal(sweep.offset_ns, np.arange(60) * 1_700_000)
    assert sweep.intensity.max() <= 1
    T = sequence.T_world_lidar(2)
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, -1, 0], atol=1e-12)
    found = dict(sequence.findings())
    assert found["times"] == "t in ns, relative" and found["poses from"].startswith("VIEWPOINT")
    assert "10 Hz: a sweep takes 1/10 s" in found["stamped by"]


@pytest.mark.parametrize(
    "name",
    [
        "1317042661.{:09d}",
        "1317042661_{:09d}",
        "1317042661{:09d}",
        "cloud_1317042661{:09d}_lidar",
    ],
)
def test_names_that_are_times(name, tmp_path):
    stamps = [99_997_611, 203_504_999]
    bare(tmp_path, [f"{name.format(ns)}.bin" for ns in stamps])
    sequence = Folder(tmp_path)
    assert list(sequence.frames) == [0, 1]
    assert [sequence.stamp_ns(f) - 1317042661 * 10**9 for f in (0, 1)] == stamps


@pytest.mark.parametrize(
    ("text", "step_ns"),
    [
        ("0.0\n0.103\n0.207\n", 103_000_000),
        ("1317042661099\n1317042661202\n1317042661306\n", 103_000_000),
        ("# times\n10\n20\n30\n", 10_000_000),
        ("2011-09-26 13:10:51.158069617\n2011-09-26 13:10:51.261\n2011-09-26T13:10:51.4\n", 0),
        ("timestamp,filename\n0.3,c_3.bin\n0.1,a_1.bin\n0.2,b_2.bin\n", 100_000_000),
        ("a_1.bin 5000000\nb_2.bin 5100000\nc_3.bin 5200000\n", 100_000_000),
    ],
)
def test_stamps_in_a_file(text, step_ns, tmp_path):
    (tmp_path / "timestamps.txt").write_text(text)
    sequence = Folder(bare(tmp_path, ["a_1.bin", "b_2.bin", "c_3.bin"]))
    got = sequence.stamp_ns(2) - sequence.stamp_ns(1)
    assert got == (step_ns or 102_930_383)


POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("zyx", [0.4, 0.02, -0.01]).as_matrix()
POSE[:3, 3] = [3.0, -2.0, 0.5]
QX, QY, QZ, QW = Rotation.from_matrix(POSE[:3, :3]).as_quat()


def numbers(*arrays):
    return " ".join(f"{v:.15g}" for a in arrays for v in np.ravel(a))


def pose_texts():
    identity = np.eye(4)
    rows3, rows4 = numbers(POSE[:3]), numbers(POSE)
    blocks = "\n".join(numbers(row) for T in (identity, POSE) for row in T)
    quaternion = f"{numbers(POSE[:3, 3])} {numbers([QX, QY, QZ, QW])}"
    return {
        "KITTI": f"{numbers(identity[:3])}\n{rows3}\n",
        "KITTI with numbers": f"2 {rows3}\n1 {numbers(identity[:3])}\n",
        "4x4 rows": f"{numbers(identity)}\n{rows4}\n",
        "4x4 blocks": blocks,
        "TUM": f"# time x y z q\n0.09 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n0.2 {quaternion}\n",
        "table": f"t,qw,qx,qy,qz,x,y,z\n0.1,1,0,0,0,0,0,0\n0.2,{numbers([QW, QX, QY, QZ])},"
        f"{numbers(POSE[:3, 3])}".replace(" ", ","),
    }


@pytest.mark.parametrize("form", pose_texts())
def test_poses_in_every_form(form, tmp_path):
    bare(tmp_path, ["1.bin", "2.bin"])
    (tmp_path / "poses.txt").write_text(pose_texts()[form])
    sequence = Folder(tmp_path)
    assert [sequence.stamp_ns(f) for f in (1, 2)] == [10**8, 2 * 10**8]
    np.testing.assert_allclose(sequence.T_world_lidar(1), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(sequence.T_world_lidar(2), POSE, atol=1e-12)


def config(folder, text):
    (folder / "densify.yaml").write_text(text)
    return folder


def test_what_poses_mean(tmp_path):
    bare(tmp_path, ["0.bin", "1.bin"])
    T_cam_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])
    (tmp_path / "cam.txt").write_text(numbers(inverse(POSE)) + "\n" + numbers(POSE) + "\n")
    text = f"poses: {{file: cam.txt, inverse: true, T_frame_lidar: {T_cam_lidar.tolist()}}}\n"
    sequence = Folder(config(tmp_path, text))
    np.testing.assert_allclose(sequence.T_world_lidar(0), POSE @ T_cam_lidar, atol=1e-12)


def test_links_to_nowhere_and_to_themselves_are_passed_over(tmp_path):
    drive, empty = bare(tmp_path / "drive", ["0.bin", "1.bin"]), tmp_path / "empty"
    empty.mkdir()
    for place in (drive, empty):
        for name, target in (("a.bin", "nowhere"), ("b.bin", "b.bin"), ("again", ".")):
            (place / name).symlink_to(target)
    assert list(open_sequence(drive).frames) == [0, 1]
    with pytest.raises(InputError, match="no known recording there"):
        open_sequence(empty)


@pytest.mark.parametrize("scale_m", ["0.001", "1e-3"])
def test_units_and_axes_are_mended(tmp_path, scale_m):
    """A camera's axes in millimetres: x to the right, y down, z forward."""
    stored = scan()[:, [1, 2, 0]] * [-1000, -1000, 1000]
    bare(tmp_path, ["0.bin"], lambda i: np.column_stack([stored, np.zeros(600)]))
    sequence = Folder(config(tmp_path, f"sweeps: {{axes: [z, -x, -y], scale_m: {scale_m}}}\n"))
    np.testing.assert_allclose(sequence[0].points, scan(), atol=1e-5)


def test_compensation_is_undone_with_stamped_poses(tmp_path):
    """At 10 m/s along x; the file's points were carried to the stamp, the start of the sweep."""
    fired, time_s = scan().astype(float), np.linspace(0, 0.0999, 600)
    stored = fired + time_s[:, None] * [10.0, 0, 0]
    table = np.column_stack([stored, np.zeros(600), time_s])
    bare(tmp_path, ["0.bin", "1.bin"], lambda i: table)
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n0.2 2 0 0 0 0 0 1\n")
    text = "sweeps: {columns: [x, y, z, intensity, time], compensated: true}\n"
    sweep = Folder(config(tmp_path, text))[0]
    np.testing.assert_allclose(sweep.points, fired, atol=1e-5)
    assert sweep.offset_ns[-1] == pytest.approx(99_900_000, abs=10)
    (tmp_path / "poses.txt").unlink()
    sequence = Folder(tmp_path)
    assert sequence[0].offset_ns is None
    assert "left out" in dict(sequence.findings())["times"]


def test_absolute_times_tell_the_rate(tmp_path):
    begin = 1_700_000_000.25

    def sweep(i):
        return {"points": scan(), "timestamp": begin + 0.05 * i + np.linspace(0, 0.0499, 600)}

    for i in range(3):
        np.savez(tmp_path / f"{i}.npz", **sweep(i))
    sequence = open_sequence(f"folder:{tmp_path}")
    assert sequence.stamp_ns(2) == pytest.approx(10**8, abs=1000)
    assert sequence[1].offset_ns[[0, -1]] == pytest.approx([0, 49_900_000], abs=1000)


def test_images_by_names_file_and_sweeps(tmp_path):
    bare(tmp_path / "lidar", ["1.bin", "2.bin"])
    for name, files in {"a": ["1.png", "2.png"], "b": ["x9.jpg"], "c": ["2.png", "5.png"]}.items():
        (tmp_path / name).mkdir()
        for file in files:
            cv2.imwrite(str(tmp_path / name / file), np.full((6, 8, 3), 90, np.uint8))
    (tmp_path / "b" / "times.csv").write_text("0.15 x9.jpg\n0.3 other.jpg\n".replace(" ", ","))
    camera = "size: [8, 6], K: [9, 9, 3.5, 2.5], T_cam_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], "
    camera += "[1, 0, 0, 0]]"
    text = "sweeps: {files: lidar, rate_hz: 20}\ncameras:\n"
    text += (
        f"  front: {{files: a, {camera}, clock_offset_s: 0.001}}\n  side: {{files: b, {camera}}}\n"
    )
    text += f"  rear: {{files: c, {camera}, stamps: sweeps, model: fisheye, "
    text += "distortion: [0, 0, 0, 0]}\n"
    sequence = Folder(config(tmp_path, text))
    assert sequence.image_stamps_ns("front") == {1: 51_000_000, 2: 101_000_000}
    assert sequence.image_stamps_ns("side") == {9: 150_000_000}
    assert sequence.image_stamps_ns("rear") == {2: 100_000_000}
    assert sequence.image("side", 9).shape == (6, 8, 3)
    assert sequence.cameras["front"].is_rectified and sequence.cameras["rear"].model == "fisheye"
    np.testing.assert_array_equal(sequence.cameras["front"].K[:2], [[9, 0, 3.5], [0, 9, 2.5]])


def test_the_documented_example_is_right(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "formats.md").read_text("utf-8")
    read = FolderConfig.read(config(tmp_path, text.split("```yaml\n")[1].split("```")[0]))
    assert read.sweeps.compensated and read.poses.T_frame_lidar[2, 3] == 1.6
    assert next(iter(read.cameras.values()))[0].K[0, 0] == 1000


# Drafts


def test_a_draft_opens_and_says_what_was_found(written, tmp_path):
    tree = shutil.copytree(written, tmp_path / "tree")
    whole = open_sequence(tree)
    (tree / "densify.yaml").unlink()
    draft = draft_config(tree)
    config(tree, draft)
    drafted = open_sequence(tree)
    assert "columns: [x, y, z, intensity, time, unknown5]" in draft and "time_unit: s" in draft
    np.testing.assert_array_equal(drafted[1].points, whole[1].points)
    np.testing.assert_array_equal(drafted[1].offset_ns, whole[1].offset_ns)
    np.testing.assert_array_equal(drafted.T_world_lidar(1), whole.T_world_lidar(1))
    assert not drafted.cameras
    filled = re.sub(r"(?m)^# (cameras:|  .*)$", r"\1", draft[draft.index("# cameras:") :])
    filled = filled.replace("[fx, fy, cx, cy]", "[721.5, 721.5, 609.5, 172.75]")
    config(tree, draft[: draft.index("# cameras:")] + filled)
    camera = open_sequence(tree).cameras["image_02"]
    assert (camera.width_px, camera.height_px) == (1242, 375)
    assert open_sequence(tree).image_stamps_ns("image_02") == whole.image_stamps_ns("image_02")


def test_a_draft_chooses_among_folders(tmp_path):
    bare(tmp_path / "top", ["1.bin"])
    bare(tmp_path / "side", ["1.bin"])
    with pytest.raises(InputError, match="several folders hold sweeps: side, top; name one in"):
        Folder(tmp_path)
    draft = draft_config(tmp_path)
    assert "files: side  # or: top" in draft
    assert list(Folder(config(tmp_path, draft)).frames) == [1]
    assert yaml.safe_load(draft)["sweeps"]["rate_hz"] == 10


# Damage


def edit(name, old, new):
    def harm(tree):
        text = (tree / name).read_text()
        assert old in text
        (tree / name).write_text(text.replace(old, new, 1))

    return harm


def line(name, number, make):
    def harm(tree):
        lines = (tree / name).read_text().splitlines()
        lines[number - 1] = make(lines[number - 1])
        (tree / name).write_text("\n".join(lines) + "\n")

    return harm


def cut_lines(name, count):
    def harm(tree):
        lines = (tree / name).read_text().splitlines()[:count]
        (tree / name).write_text("\n".join(lines) + "\n")

    return harm


YAML = "densify.yaml"
TREES = {
    "no yaml": (lambda t: (t / YAML).write_text("a: [1"), r"densify\.yaml: not YAML"),
    "a list": (lambda t: (t / YAML).write_text("- 1"), "expected a mapping such as"),
    "a tag": (
        lambda t: (t / YAML).write_text("sweeps: !!python/object/apply:os.getcwd []"),
        "not YAML: could not determine a constructor",
    ),
    "given twice": (
        lambda t: (t / YAML).write_text("poses: {}\nposes: {}"),
        "line 2: poses is giv",
    ),
    "unknown section": (edit(YAML, "poses:", "pose:"), "pose: unknown key; did you mean poses"),
    "unknown key": (
        edit(YAML, "time_is", "time_iss"),
        r"line 7: sweeps\.time_iss: unknown key; did",
    ),
    "axes": (
        edit(YAML, "time_unit: s", "axes: [x, y, x]"),
        r"axes: got .* expected x, y and z in some order",
    ),
    "unit": (edit(YAML, "time_unit: s", "time_unit: sec"), "got 'sec', expected one of s, ms"),
    "text for a number": (edit(YAML, "scale: 1.0", "scale: full"), "got 'full', expected a finite"),
    "columns": (edit(YAML, "[x, y, z,", "[a, y, z,"), "no column x: got a, y"),
    "fewer columns": (edit(YAML, ", lidar]", "]"), "multiple of 20"),
    "unknown column": (
        edit(YAML, "time_unit", "time: tee\n  time_unit"),
        r"sweeps\.time: got 'tee', expected a column of 000000\.bin",
    ),
    "scanner without a place": (
        edit(YAML, "scanner_origins:", "lidar: intensity\n  scanner_origins:"),
        "expected the number of a scanner, 0 to 0",
    ),
    "origins of two numbers": (
        edit(YAML, "- [0.0, 0.0, 0.0]\nposes", "- [0.0, 0.0]\nposes"),
        r"line 10: sweeps\.scanner_origins: .* shape \(N, 3\)",
    ),
    "sweeps elsewhere": (edit(YAML, "files: sweeps", "files: swept"), "no such folder, though"),
    "no sweeps": (lambda t: [p.unlink() for p in (t / "sweeps").iterdir()], "no sweeps; expected"),
    "no such stamps": (edit(YAML, "timestamps.txt", "stamps.txt"), r"stamps\.txt: no such file"),
    "a stamp too few": (cut_lines("timestamps.txt", 2), "got 2 times for 3 files"),
    "a stamp no number": (line("timestamps.txt", 2, lambda s: "noon"), "line 2: got 'noon', expec"),
    "stamps go back": (line("timestamps.txt", 2, lambda s: "1781258405"), "not after"),
    "no such poses": (edit(YAML, "poses.txt", "path.txt"), r"path\.txt: no such file, though"),
    "poses empty": (lambda t: (t / "poses.txt").write_text(""), "holds no poses"),
    "pose cut": (line("poses.txt", 3, lambda s: s[:30]), "line 3: got 2 numbers, expected 8"),
    "pose not a number": (
        line("poses.txt", 3, lambda s: s.replace(" ", " nan ", 1).rsplit(" ", 1)[0]),
        "line 3: got a value that is not finite",
    ),
    "quaternion too long": (
        line("poses.txt", 3, lambda s: s + "7"[:0] + "" if False else s.rsplit(" ", 1)[0] + " 4"),
        "line 3: got a quaternion of length",
    ),
    "poses of no form": (
        lambda t: (t / "poses.txt").write_text("1 2 3 4 5 6 7\n"),
        "got 7 numbers, expected 12",
    ),
    "poses go back": (
        line("poses.txt", 5, lambda s: s.replace("1781", "1780", 1)),
        "stamps that ascend",
    ),
    "K without focal length": (
        edit(YAML, "[721.5, 0.0, 609.5]", "[0, 0, 9]"),
        "with fx and fy above",
    ),
    "K of text": (
        edit(YAML, "[721.5, 0.0, 609.5]", "[fx, 0, 9]"),
        r"image_02\.K: got .* expected num",
    ),
    "no T_cam_lidar": (
        edit(YAML, "T_cam_lidar", "T_lidar_cam"),
        "T_cam_lidar: got nothing, expected f",
    ),
    "T_cam_lidar no rotation": (
        edit(YAML, "- [0.0, 0.0, 0.0, 1.0]", "- [0, 0, 0, 1]\nx: 1"),
        "x: unk",
    ),
    "camera name": (
        edit(YAML, "  image_02:\n", "  ../cam:\n"),
        "got the name .* expected letters",
    ),
    "coefficients": (
        edit(YAML, "distortion: []", "distortion: [1, 2, 3]"),
        "0, 4, 5, 8, 12, 14 coef",
    ),
    "fraction of a pixel": (edit(YAML, "[1242, 375]", "[1242.5, 375]"), "in whole pixels"),
    "model": (edit(YAML, "model: pinhole", "model: wide"), "expected one of pinhole, fisheye, mei"),
    "no images": (lambda t: shutil.rmtree(t / "images/image_02"), "no images, though densify"),
    "image without a time": (
        lambda t: next((t / "images/image_02").iterdir()).rename(t / "images/image_02/a.png"),
        "its name is no time",
    ),
}


@pytest.mark.parametrize("damage", TREES)
def test_damaged_folders_are_refused_in_a_line(broken, damage):
    harm, says = TREES[damage]
    harm(broken)
    with pytest.raises(InputError) as error:
        sequence = open_sequence(f"folder:{broken}")
        sequence[0]
        sequence.T_world_lidar(0)
    message = str(error.value)
    assert "\n" not in message and str(broken) in message and re.search(says, message), message


def test_a_rotation_that_is_none_names_its_line(broken):
    text = (broken / YAML).read_text()
    config(broken, re.sub(r"T_cam_lidar:\n    - \[-?[\d.]+", "T_cam_lidar:\n    - [0.5", text))
    with pytest.raises(
        InputError, match=r"line \d+: cameras\.image_02\.T_cam_lidar: .*not a rotat"
    ):
        open_sequence(broken)


def test_damaged_sweeps_and_images_are_refused_in_a_line(broken):
    sequence = open_sequence(broken)
    image = sorted((broken / "images/image_02").iterdir())[0]
    image.write_bytes(image.read_bytes()[:2000])
    with pytest.raises(InputError, match=r"not a complete image|got an image"):
        sequence.image(CAMERA, 0)
    cv2.imwrite(str(image), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(InputError, match="9 x 9 px; expected 1242 x 375"):
        sequence.image(CAMERA, 0)
    path = broken / "sweeps" / "000001.bin"
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(InputError, match=r"000001\.bin.*expected a multiple of 24"):
        sequence[1]
    table = np.full((4, 6), np.nan, "<f4")
    table.tofile(path)
    with pytest.raises(InputError, match="4 rows, none valid"):
        sequence[1]
    table[:] = [1, 2, 3, 0.5, np.nan, 0]
    table.tofile(path)
    with pytest.raises(InputError, match="time that is not finite"):
        sequence[1]
    assert len(sequence[2]) > 1000


def test_two_files_of_one_number(tmp_path):
    bare(tmp_path, ["a_01.bin", "b_1.bin"])
    with pytest.raises(InputError, match=r"has the number 1, as a_01\.bin has"):
        Folder(tmp_path)


# Real sweeps


def test_real_sweeps_without_a_word_beside_them(test_data):
    kitti = open_sequence(test_data / "kitti_odometry/sequences/00/velodyne")
    assert len(kitti.frames) == 3 and kitti[0].points.shape == (124_668, 3)
    raw = test_data / "kitti/2011_09_26/2011_09_26_drive_0013_sync"
    plain, known = open_sequence(f"folder:{raw}"), open_sequence(raw)
    assert list(plain.frames) == list(known.frames)
    np.testing.assert_array_equal(plain[100].points, known[100].points)
    assert [plain.stamp_ns(f) for f in plain.frames] == [known.stamp_ns(f) for f in known.frames]
    nuscenes = open_sequence(f"folder:{test_data / 'nuscenes'}")
    assert nuscenes[0].points.shape == (34_688, 3) and nuscenes[0].intensity.max() <= 1
    assert "column4 (0 to 31)" in dict(nuscenes.findings())["fields"]
    points = transform(np.eye(4), nuscenes[0].points)
    assert -2.5 < np.median(points[points[:, 2] < -1, 2]) < -1.5  # the ground below the roof
