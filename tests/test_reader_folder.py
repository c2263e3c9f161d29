# SPDX-License-Identifier: MIT
"""Folders of no known form: a street written as one, files of every kind beside each other, and
damage."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from writers.excerpt import Excerpt

from densify.config.errors import InputError
from densify.geometry.clock import share_of_turn
from densify.geometry.poses import inverse
from densify.outputs.simulated_street import config_text
from densify.readers import describe, open_sequence
from densify.readers.folder import Folder
from densify.readers.folder_config import FolderConfig
from densify.readers.kitti import KittiRaw
from densify.readers.kitti_files import Calibration
from densify.readers.street import Street
from tests.command import exit_code
from tests.dataset_scenes import copy_drive
from tests.reader_checks import check_cameras, check_refused, check_sweeps, check_truth
from tests.test_point_files import pcd
from tests.test_reader_damage import LFS

FORMAT = "folder"


def test_the_street_is_given_back(written, excerpt):
    sequence = open_sequence(written)
    assert isinstance(sequence, Folder)
    check_sweeps(sequence, excerpt, offset_ns=4)  # float32 seconds
    check_cameras(sequence, excerpt)
    check_truth(sequence, excerpt)


def test_scanners_lenses_and_rolling_shutters_are_kept(tmp_path):
    street = Street("static", 0, "panda", cameras=("fisheye", "rolling"))
    config(tmp_path, config_text(Excerpt.of(street, [60], None)))
    read = FolderConfig.read(tmp_path)
    np.testing.assert_allclose(read.sweeps.scanner_origins, street.simulator.sensor.origins_m)
    assert read.sweeps.columns[-1] == "lidar"
    for name, files in read.cameras.items():
        for key, value in vars(files.camera(name)).items():
            np.testing.assert_array_equal(value, getattr(street.cameras[name], key))
    origins = "scanner_origins: [[0, 0, 0], [1, 0, -0.5]]"
    config(tmp_path, f"sweeps: {{columns: [x, y, z, lidar], {origins}}}\n")
    bare(tmp_path, ["0.bin"], np.column_stack([scan(), np.arange(600) % 2]))
    sweep = Folder(tmp_path)[0]
    np.testing.assert_array_equal(sweep.lidar, np.arange(600) % 2)
    np.testing.assert_array_equal(sweep.scanner_origins, [[0, 0, 0], [1, 0, -0.5]])


# --- without densify.yaml -------------------------------------------------------------------------


def scan(num=600):
    """A ring on the ground and a wall, in the order of firing."""
    azimuth = np.linspace(-np.pi, np.pi, num, endpoint=False)
    wall = np.where(np.arange(num) // 50 % 2, 8.0, 12.0)
    return np.column_stack(
        [wall * np.cos(azimuth), wall * np.sin(azimuth), np.where(wall > 10, 1.0, -1.7)]
    ).astype("<f4")


def bare(folder: Path, names, table=None):
    """A folder of sweeps (N,...) float32."""
    folder.mkdir(parents=True, exist_ok=True)
    table = np.column_stack([scan(), np.full(600, 0.5)]) if table is None else table
    for name in names:
        table.astype("<f4").tofile(folder / name)
    return folder


def config(folder, text):
    (folder / "densify.yaml").write_text(text)
    return folder


def test_numbered_files_alone_open(tmp_path):
    drive = bare(tmp_path / "drive", ["000003.bin", "000004.bin", "000007.bin"])
    for name, target in (("a.bin", "nowhere"), ("b.bin", "b.bin"), ("again", ".")):
        (drive / name).symlink_to(target)
    sequence = open_sequence(drive)
    assert list(sequence.frames) == [3, 4, 7] and not sequence.cameras
    assert [sequence.stamp_ns(f) for f in sequence.frames] == [3 * 10**8, 4 * 10**8, 7 * 10**8]
    sweep = sequence[4]
    np.testing.assert_array_equal(sweep.points, scan())
    assert sweep.offset_ns is None and set(sweep.intensity) == {0.5}
    text = describe(sequence)
    assert "assumed 10 Hz" in text and "intensity = intensity" in text
    assert re.search(r"^poses +none$", text, re.M)
    with pytest.raises(InputError, match="no poses; let the sweeps register themselves"):
        sequence.T_world_lidar(3)


@pytest.mark.parametrize("column", ["x", "z", "t", "lidar", "intensity"])
def test_a_value_that_is_not_finite_costs_its_point_alone(column, tmp_path):
    """An intensity that is not finite becomes 0."""
    columns = dict(zip("xyz", scan().T.copy(), strict=True))
    columns |= {"lidar": np.zeros(600), "t": np.linspace(0, 0.0999, 600), "intensity": np.ones(600)}
    columns[column][7:10] = [np.nan, np.inf, -np.inf]
    np.savez(tmp_path / "0.npz", **columns)
    sweep = Folder(config(tmp_path, "sweeps: {lidar: lidar}"))[0]
    wrong = sweep.intensity == 0 if column == "intensity" else ~np.isin(np.arange(600), sweep.row)
    np.testing.assert_array_equal(np.flatnonzero(wrong), [7, 8, 9])


@pytest.mark.parametrize("form", ["{}.{:09d}", "{}_{:09d}", "cloud_{}{:09d}_lidar"])
def test_names_that_are_times(form, tmp_path):
    stamps = [99_997_611, 203_504_999]
    sequence = Folder(bare(tmp_path, [f"{form.format(1317042661, ns)}.bin" for ns in stamps]))
    assert [sequence.stamp_ns(f) - 1317042661 * 10**9 for f in (0, 1)] == stamps


@pytest.mark.parametrize(
    ("text", "step_ns"),
    [
        ("0.0\n0.103\n0.207\n", 104_000_000),
        ("1317042661099\n1317042661202\n1317042661306\n", 104_000_000),
        ("# times\n10\n10.1\n10.3\n", 200_000_000),
        ("2011-09-26 13:10:51.1\n2011-09-26 13:10:51.261\n2011-09-26T13:10:51.4\n", 139_000_000),
        ("timestamp,filename\n0.3,c_3.bin\n0.1,a_1.bin\n0.2,b_2.bin\n", 100_000_000),
        ("a_1.bin 5.0\nb_2.bin 5.1\nc_3.bin 5.2\n", 100_000_000),
        ("\ufeff0.0\r\n0.1\r\n0.2\r\n", 100_000_000),
    ],
)
def test_stamps_in_a_file(text, step_ns, tmp_path):
    (tmp_path / "timestamps.txt").write_text(text)
    sequence = Folder(bare(tmp_path, ["a_1.bin", "b_2.bin", "c_3.bin"]))
    assert sequence.stamp_ns(3) - sequence.stamp_ns(2) == step_ns


# --- poses ----------------------------------------------------------------------------------------

POSE = np.eye(4)
POSE[:3, :3] = Rotation.from_euler("zyx", [0.4, 0.02, -0.01]).as_matrix()
POSE[:3, 3] = [3.0, -2.0, 0.5]
QX, QY, QZ, QW = Rotation.from_matrix(POSE[:3, :3]).as_quat()


def numbers(*arrays):
    return " ".join(f"{v:.15g}" for a in arrays for v in np.ravel(a))


PLACE, ONE = numbers(POSE[:3, 3]), np.eye(4)
POSE_TEXTS = {
    "KITTI": f"{numbers(ONE[:3])}\n{numbers(POSE[:3])}\n",
    "4x4 rows": f"{numbers(ONE)}\n{numbers(POSE)}\n",
    "TUM": f"# time\n0.09 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n0.2 {PLACE} {QX} {QY} {QZ} {QW}",
    "table": f"t,qw,qx,qy,qz,x,y,z\n0.1,1,0,0,0,0,0,0\n0.2,{QW},{QX},{QY},{QZ},"
    + PLACE.replace(" ", ","),
}


@pytest.mark.parametrize("form", POSE_TEXTS)
def test_poses_in_every_form(form, tmp_path):
    (tmp_path / "poses.txt").write_text(POSE_TEXTS[form])
    sequence = Folder(bare(tmp_path, ["1.bin", "2.bin"]))
    np.testing.assert_allclose(sequence.T_world_lidar(1), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(sequence.T_world_lidar(2), POSE, atol=1e-12)


def test_poses_of_other_frames_and_inverse_ones(tmp_path):
    T_cam_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])
    (tmp_path / "cam.txt").write_text(numbers(inverse(POSE)) + "\n" + numbers(POSE) + "\n")
    text = f"poses: {{file: cam.txt, inverse: true, T_frame_lidar: {T_cam_lidar.tolist()}}}\n"
    sequence = Folder(config(bare(tmp_path, ["0.bin", "1.bin"]), text))
    np.testing.assert_allclose(sequence.T_world_lidar(0), POSE @ T_cam_lidar, atol=1e-12)


def test_units_and_axes_are_mended(tmp_path):
    """A camera's axes in millimetres: x to the right, y down, z forward."""
    stored = scan()[:, [1, 2, 0]] * [-1000, -1000, 1000]
    bare(tmp_path, ["0.bin"], np.column_stack([stored, np.zeros(600)]))
    sequence = Folder(config(tmp_path, "sweeps: {axes: [z, -x, -y], scale_m: 1e-3}\n"))
    np.testing.assert_allclose(sequence[0].points, scan(), atol=1e-5)


def test_compensation_is_undone_with_stamped_poses(tmp_path):
    """At 10 m/s along x; the file's points were carried to the stamp, the start of the sweep."""
    fired, time_s = scan().astype(float), np.linspace(0, 0.0999, 600)
    stored = fired + time_s[:, None] * [10.0, 0, 0]
    bare(tmp_path, ["0.bin", "1.bin"], np.column_stack([stored, np.zeros(600), time_s]))
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n0.2 2 0 0 0 0 0 1\n")
    config(tmp_path, "sweeps: {columns: [x, y, z, intensity, time], compensated: true}\n")
    sweep = Folder(tmp_path)[0]
    np.testing.assert_allclose(sweep.points, fired, atol=1e-5)
    assert sweep.offset_ns[-1] == pytest.approx(99_900_000, abs=10)
    (tmp_path / "poses.txt").unlink()
    sequence = Folder(tmp_path)
    assert sequence[0].offset_ns is None
    assert "left out" in dict(sequence.findings())["times"]


@pytest.mark.parametrize(
    ("keys", "first_deg", "first_ms"),
    [
        ("turn: anticlockwise, reference: start", 180, 0),  # the order of the points of scan()
        ("turn: anticlockwise, reference: start, start_deg: -180", 180, 0),
        ("turn: anticlockwise, reference: end, start_deg: 90", 90, -100),
        ("turn: anticlockwise", 180, -50),
        ("start_deg: 90, reference: start, rate_hz: 20", 90, 0),
    ],
)
def test_times_by_azimuth(keys, first_deg, first_ms, tmp_path):
    """A scanner at (1, 2, 0), whose file has a column of times that are not used."""
    azimuth_deg = np.rad2deg(np.arctan2(*scan().astype(float).T[1::-1]))
    sign, turn_ms = (1 if "anti" in keys else -1), (50 if "20" in keys else 100)
    share = np.round(sign * (azimuth_deg - first_deg) / 360, 6) % 1
    expected_ms = first_ms + share * turn_ms
    table = np.column_stack([scan() + [1, 2, 0], np.linspace(0, 0.0999, 600)])
    bare(tmp_path, ["0.bin", "1.bin"], table)
    (tmp_path / "timestamps.txt").write_text("0.0\n0.1\n")
    text = f"columns: [x, y, z, time], time: azimuth, scanner_origins: [[1, 2, 0]], {keys}"
    sequence = Folder(config(tmp_path, f"sweeps: {{{text}}}\n"))
    off_ms = sequence[1].offset_ns * 1e-6 - expected_ms
    off_ms[np.abs(share - np.rint(share)) < 1e-5] = 0  # the first is as well the last
    np.testing.assert_allclose(off_ms, 0, atol=1e-3)
    assert "by azimuth" in dict(sequence.findings())["times"]


def test_times_by_azimuth_undo_a_compensation(tmp_path):
    """At 10 m/s along x, as KITTI's odometry stores its sweeps, or placed in a map."""
    fired = scan().astype(float)
    time_s = 0.1 * share_of_turn(fired)
    stored = fired + time_s[:, None] * [10.0, 0, 0]
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n0.2 2 0 0 0 0 0 1\n")
    for moved_m, key in ((0.0, "compensated: true"), (1.0, "frame: poses")):
        bare(tmp_path, ["0.bin", "1.bin"], np.column_stack([stored + [moved_m, 0, 0], time_s]))
        sequence = Folder(config(tmp_path, f"sweeps: {{time: azimuth, {key}}}\n"))
        inside = np.abs(time_s) < 0.049  # the first and the last are neighbours
        np.testing.assert_allclose(sequence[1].points[inside], fired[inside], atol=1e-3)
        np.testing.assert_allclose(sequence[1].offset_ns[inside] * 1e-9, time_s[inside], atol=1e-4)


def test_times_by_azimuth_are_those_of_a_kitti_drive(border_drive, tmp_path):
    check_times_of(border_drive, tmp_path)


def check_times_of(drive: Path, folder: Path) -> None:
    """Check that the sweeps of a KITTI drive in a plain folder have the times of the drive."""
    known = KittiRaw(drive)
    velodyne = drive / "velodyne_points"
    lines = (velodyne / "timestamps.txt").read_text().splitlines()
    (folder / "timestamps.txt").write_text("\n".join(lines[frame] for frame in known.frames))
    for path in (velodyne / "data").iterdir():
        (folder / path.name).symlink_to(path)
    plain = Folder(config(folder, "sweeps: {time: azimuth}\n"))
    for frame in known.frames[:: len(known.frames) // 3]:
        assert plain.stamp_ns(frame) == known.stamp_ns(frame)
        np.testing.assert_allclose(plain[frame].offset_ns, known[frame].offset_ns, atol=100_000)


@pytest.mark.parametrize("timed", [True, False])
def test_sweeps_in_the_frame_of_their_poses_are_taken_back(timed, tmp_path):
    """Each point was placed with the pose of its moment; without times, with that of the stamp."""
    fired, time_s = scan().astype(float), np.linspace(0, 0.0999, 600) * timed
    turn = Rotation.from_euler("z", 40, degrees=True)
    placed = turn.apply(fired) + (5 + time_s[:, None] * 10) * [1.0, 0, 0]
    q = " ".join(map(str, turn.as_quat()))
    bare(tmp_path, ["0.bin", "1.bin"], np.column_stack([placed, time_s]))
    config(tmp_path, "sweeps: {columns: [x, y, z, time], frame: poses}\n")
    with pytest.raises(InputError, match="there are no poses"):
        Folder(tmp_path)
    (tmp_path / "poses.txt").write_text(f"0 5 0 0 {q}\n0.1 6 0 0 {q}\n0.2 7 0 0 {q}\n")
    np.testing.assert_allclose(Folder(tmp_path)[0].points, fired, atol=1e-5)


def test_viewpoints_of_pcd_files_are_poses(tmp_path):
    def write(name, viewpoint):
        lines = re.sub(rb"VIEWPOINT [^\n]*", f"VIEWPOINT {viewpoint}".encode(), pcd("binary"))
        (tmp_path / name).write_bytes(lines)

    default = "0 0 0 1 0 0 0"
    write("0.pcd", default)
    for unknown in (default, "1 2 3 0 0 0 0"):  # some programs write no rotation
        write("1.pcd", unknown)
        with pytest.raises(InputError, match="no poses"):
            Folder(tmp_path).T_world_lidar(1)
    write("1.pcd", f"{PLACE} {QW} {QX} {QY} {QZ}")
    sequence = Folder(tmp_path)
    np.testing.assert_allclose(sequence.T_world_lidar(0), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(sequence.T_world_lidar(1), POSE, atol=1e-12)
    assert "VIEWPOINT" in dict(sequence.findings())["poses from"]


def test_poses_beside_each_sweep(tmp_path):
    bare(tmp_path, ["0.bin", "1.bin", "2.bin"])
    for words in ("1 0 0 {0} 0 1 0 0 0 0 1 2", "{0} 0 2 0 0 0 1"):
        for i in range(3):
            (tmp_path / f"{i}.pose").write_text(words.format(3.0 * i))
        np.testing.assert_allclose(Folder(tmp_path).T_world_lidar(2)[:3, 3], [6, 0, 2])
    (tmp_path / "1.pose").write_text("1 2 3\n0 0 90\n")
    with pytest.raises(InputError, match=r"1\.pose: got 6 numbers, expected 12 or 16"):
        Folder(tmp_path)


# --- cameras, the example -------------------------------------------------------------------------


def cameras(folder: Path) -> Path:
    """Two sweeps and three cameras, whose images are stamped in three ways."""
    bare(folder / "lidar", ["1.bin", "2.bin"])
    for name, files in {"a": ["1.png", "2.png"], "b": ["x9.jpg"], "c": ["2.png", "5.png"]}.items():
        (folder / name).mkdir()
        for file in files:
            cv2.imwrite(str(folder / name / file), np.full((6, 8, 3), 90, np.uint8))
    (folder / "b" / "times.csv").write_text("0.15,x9.jpg\n0.3,other.jpg\n")
    T = "[[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]"
    shared = f"size: [8, 6], K: [9, 9, 3.5, 2.5], T_cam_lidar: {T}"
    text = f"""sweeps: {{files: lidar, rate_hz: 20}}
cameras:
  front: {{files: a, {shared}, clock_offset_s: 0.001}}
  side: {{files: b, {shared}}}
  rear: {{files: c, {shared}, stamps: sweeps, model: fisheye, distortion: [0, 0, 0, 0]}}
"""
    return config(folder, text)


def test_images_by_names_file_and_sweeps(tmp_path):
    sequence = Folder(cameras(tmp_path))
    assert sequence.image_stamps_ns("front") == {1: 51_000_000, 2: 101_000_000}
    assert sequence.image_stamps_ns("side") == {9: 150_000_000}
    assert sequence.image_stamps_ns("rear") == {2: 100_000_000}
    assert sequence.image("side", 9).shape == (6, 8, 3)
    assert sequence.cameras["front"].is_rectified and sequence.cameras["rear"].model == "fisheye"
    np.testing.assert_array_equal(sequence.cameras["front"].K[:2], [[9, 0, 3.5], [0, 9, 2.5]])
    (told,) = sequence.gaps()
    assert told.startswith("front: 2 images without stamps beside 2 sweeps: each is taken as")
    assert told.removeprefix("front: ") in describe(sequence) and "rates" not in told
    bare(tmp_path / "lidar", ["3.bin"])
    assert "if their rates differ, give the images' times" in Folder(tmp_path).gaps()[0]


def test_the_documented_example_is_right(tmp_path):
    text = (Path(__file__).parents[1] / "docs" / "your-recording.md").read_text("utf-8")
    read = FolderConfig.read(config(tmp_path, text.split("```yaml\n")[1].split("```")[0]))
    assert read.sweeps.time == "t" and read.cameras["front"].K[0, 0] == 1000


def test_the_documented_chain_of_calibrations_is_right(border_drive):
    text = (Path(__file__).parents[1] / "docs" / "your-recording.md").read_text("utf-8")
    (chain,) = (block for block in text.split("```")[1::2] if "T_cam_rect @" in block)
    names = {"np": np}
    for file, shapes in {
        "calib_velo_to_cam.txt": {"R": (3, 3), "T": (3,)},
        "calib_cam_to_cam.txt": {"R_rect_00": (3, 3), "P_rect_02": (3, 4)},
    }.items():
        calibration = Calibration.read(border_drive.parent / file)
        names |= {key: calibration.numbers(key, *shape) for key, shape in shapes.items()}
    exec(chain.removeprefix("python\n"), names)
    camera = KittiRaw(border_drive).cameras["image_02"]
    np.testing.assert_allclose(names["T_cam_lidar"], camera.T_cam_lidar, atol=1e-9)
    np.testing.assert_allclose(names["P_rect_02"][:, :3], camera.K, atol=1e-9)


# --- damage ---------------------------------------------------------------------------------------

WRONG_CONFIGS = [
    ("a: [1", r"densify\.yaml: not YAML"),
    ("sweeps: !!python/object/apply:os.getcwd []", "not YAML: could not determine a constructor"),
    ("poses: {}\nposes: {}", "line 2: poses is given twice"),
    ("sweeps:\n  time_iss: x", r"line 2: sweeps\.time_iss: unknown key; did you mean time_is"),
    ("sweeps: {scale_m: full}", "got 'full', expected a finite number above 0"),
    ("sweeps: {columns: [x, y, z, i, a, b, c]}", "multiple of 28"),
    ("sweeps: {time: tee}", r"sweeps\.time: got 'tee', expected a column of 0\.bin"),
    ("sweeps: {turn: clockwise}", r"sweeps\.turn: only times by azimuth use it: time: azimuth"),
    ("sweeps: {time: azimuth, turn: left}", "got 'left', expected one of clockwise, anticlockwise"),
    ("sweeps: {lidar: intensity}", "expected the number of a scanner, 0 to 255"),
    ("sweeps: {scanner_origins: [[0, 0]]}", r"sweeps\.scanner_origins: .* shape \(N, 3\)"),
    ("sweeps: {stamps: names}", "its name is no time"),
    ("poses: {file: path.txt}", r"path\.txt: no such file, though"),
    ("cameras: {../cam: {}}", "expected a name of letters"),
]
CAMERA_EDITS = [
    ("K: [9, 9", "K: [0, 9", "with fx and fy above 0"),
    ("K: [9, 9", "K: [fx, 9", r"front\.K: got .*expected .fx, fy"),
    ("[1, 0, 0, 0]]", "[1, 0, 0]]", r"front\.T_cam_lidar: .*; row 3 has 3 numbers, not 4"),
    (
        "[[0, -1, 0, 0]",
        "[[0.5, -1, 0, 0]",
        r"front\.T_cam_lidar: .*not a rotation \(R R. is off by",
    ),
    ("[[0, -1, 0, 0]", "[[0.5, -1, 0, 0]", r"front\.T_cam_lidar: .*three or four rows"),
    ("fisheye, distortion: [0, 0, 0, 0]", "pinhole, distortion: [1, 2]", "0, 4, 5, 8, 12, 14 co"),
    ("files: a,", "files: nowhere,", "no images, though densify"),
    ("size: [8, 6]", "size: [9, 6]", "got an image of 8 x 6 px; expected 9 x 6, as the calib"),
]
WRONG_FILES = [
    ("timestamps.txt", "1317042661.1\n", "got 1 times for 2 files"),
    ("timestamps.txt", "1.31704e+09\n1.31704e+09\n", "1 of 1 times are equal .* lost digits"),
    ("timestamps.txt", "\x000\x00.\x001", "is text in UTF-16, expected UTF-8"),
    ("poses.txt", "1e9 0 0 0 0 0 0 1\n1e9 0 0 0 0 0 0 1\n", "lost digits; write them anew"),
    ("timestamps.txt", "0.1\nnoon\n", "line 2: got 'noon', expected a time in s"),
    ("timestamps.txt", "100\n200\n", "too far apart for seconds.*stamps_unit"),
    ("poses.txt", "0.1 0 0 0 0 0 0 1\n0.2 0", "line 2: got 2 columns, expected 8"),
    ("poses.txt", "0.1 0 0 0 0 0 0 4\n", "line 1: got a quaternion of length"),
    ("poses.txt", "0.2 0 0 0 0 0 0 1\n0.1 0 0 0 0 0 0 1\n", "stamps that ascend"),
    ("a_1.bin", "", r"has the number 1, as 1\.bin has|1\.bin: has the number 1, as a_1\.bin has"),
]


def edit(name, text):
    return lambda folder: (folder / name).write_text(text)


def edit_camera(old, new):
    def change(folder):
        for path in folder.glob("*.bin"):
            path.unlink()
        text = (cameras(folder) / "densify.yaml").read_text()
        assert old in text
        config(folder, text.replace(old, new, 1))

    return change


def empty(folder):
    for path in folder.glob("*.bin"):
        path.write_bytes(b"")


WRONG = [
    (empty, "all 2 files of sweeps are empty"),
    *((edit("densify.yaml", text), says) for text, says in WRONG_CONFIGS),
    *((edit_camera(old, new), says) for old, new, says in CAMERA_EDITS),
    *((edit(name, text), says) for name, text, says in WRONG_FILES),
]


@pytest.mark.parametrize(("change", "says"), WRONG, ids=[says for _, says in WRONG])
def test_what_is_wrong_is_refused_in_a_line(change, says, tmp_path):
    change(bare(tmp_path, ["0.bin", "1.bin"]))
    check_refused(f"folder:{tmp_path}", says, tmp_path)


def test_damaged_sweeps_and_images_are_refused_in_a_line(tmp_path):
    sequence = Folder(cameras(tmp_path))
    cv2.imwrite(str(tmp_path / "a/1.png"), np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(InputError, match="9 x 9 px; expected 8 x 6"):
        sequence.image("front", 1)
    path = tmp_path / "lidar/2.bin"
    rows = np.fromfile(path, "<f4")
    for table, says in ((rows[:-1], "multiple of 16"), (rows[:8] * np.nan, "2 rows, none valid")):
        table.tofile(path)
        with pytest.raises(InputError, match=rf"2\.bin.*{says}"):
            sequence[2]


@pytest.mark.parametrize("suffix", [".bin", ".pcd", ".ply", ".npy", ".npz", ".csv", ".las", ".bag"])
def test_pointers_of_git_lfs_are_called_that(suffix, tmp_path, capsys):
    for i in range(2 - (suffix == ".bag")):
        (tmp_path / f"{i:06d}{suffix}").write_text(LFS)
    assert exit_code("info", tmp_path) == 2
    assert "is a Git LFS pointer, not the data; run git lfs pull" in capsys.readouterr().err


def test_a_folder_that_is_no_recording_says_what_is_there(border_drive, tmp_path):
    (tmp_path / "pictures").mkdir()
    for i in range(3):
        (tmp_path / "pictures" / f"{i}.JPG").write_bytes(b"x")
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.odt").write_text("x")
    drive = border_drive
    places = {
        tmp_path / "pictures": "it holds 3 .jpg files, no lidar sweeps;",
        tmp_path / "empty": "it is empty;",
        tmp_path / "notes.odt": "it is a .odt file;",
        drive / "image_02": f"it holds 1 folder, .*inside a KITTI drive: give {drive};",
        drive / "image_02" / "data": f"it holds .*inside a KITTI drive: give {drive};",
    }
    for place, says in places.items():
        with pytest.raises(InputError, match=says) as error:
            open_sequence(place)
        assert len(str(error.value)) < 500
        assert "densify info --help says what each reads" in str(error.value)


def test_the_sweeps_of_a_drive_alone_say_what_is_lost(border_drive):
    for place in (border_drive / "velodyne_points", border_drive / "velodyne_points" / "data"):
        sequence = open_sequence(place)
        assert f"the KITTI drive {border_drive}, which has more: name that" in describe(sequence)
        told = "\n".join(sequence.gaps())
        assert f"is a part of the KITTI drive {border_drive}: read alone it has no times" in told


def test_a_drive_that_is_a_link_has_the_calibration_beside_it(border_drive, tmp_path):
    target = copy_drive(border_drive, tmp_path / "store" / "2011_09_26")
    link = tmp_path / "mine" / target.name
    link.parent.mkdir()
    link.symlink_to(target)
    assert KittiRaw(link).cameras["image_02"].width_px
    for path in target.parent.glob("calib_*.txt"):
        text = path.read_text().replace("P_rect_02: ", "P_rect_02: 1")  # 1x fx
        (link.parent / path.name).write_text(text)
    ours, theirs = (KittiRaw(place).cameras["image_02"].K[0, 0] for place in (link, target))
    assert ours != theirs


# --- real sweeps ----------------------------------------------------------------------------------


def test_real_sweeps_without_a_word_beside_them(test_data, tmp_path):
    kitti = open_sequence(test_data / "kitti_odometry/sequences/00/velodyne")
    assert len(kitti.frames) == 3 and kitti[0].points.shape == (124_668, 3)
    raw = test_data / "kitti/2011_09_26/2011_09_26_drive_0013_sync"
    plain, known = open_sequence(f"folder:{raw}"), open_sequence(raw)
    assert list(plain.frames) == list(known.frames)
    np.testing.assert_array_equal(plain[100].points, known[100].points)
    assert [plain.stamp_ns(f) for f in plain.frames] == [known.stamp_ns(f) for f in known.frames]
    check_times_of(raw, tmp_path)
