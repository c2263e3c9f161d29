# SPDX-License-Identifier: MIT
"""The KITTI raw reader on tiny drives written here, on broken ones, and on real ones."""

import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry import poses
from densify.readers import describe
from densify.readers.kitti import KITTI_TRIGGER_LATENCY_NS, KittiRaw

# The epoch nanoseconds of this text do not survive a float64 (multiples of 256 there).
BASE_NS = 1317042651_000_000_000
PERIOD_NS = 103_500_007
NUM_LINES = 8
FRAMES = (2, 3, 5)
SIZE = (40, 20)  # width, height

R_VELO_TO_CAM = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
R_RECT = Rotation.from_euler("xyz", [0.01, -0.02, 0.005]).as_matrix()
T_VELO_TO_CAM = np.array([0.01, -0.08, -0.27])
K = np.array([[50.0, 0, 19.5], [0, 50.0, 9.5], [0, 0, 1]])
OFFSET_02 = np.array([0.06, 0.0, 0.003])
T_LIDAR_IMU = np.eye(4)
T_LIDAR_IMU[:3, :3] = Rotation.from_euler("z", 0.4, degrees=True).as_matrix()
T_LIDAR_IMU[:3, 3] = [-0.8, 0.3, -0.8]


def stamp_ns(frame):
    return BASE_NS + 158_069_617 + frame * PERIOD_NS


def stamp_text(ns):
    seconds, fraction = divmod(ns - BASE_NS, 1_000_000_000)
    return f"2011-09-26 13:10:{51 + seconds:02d}.{fraction:09d}"


def words(array):
    return " ".join(f"{value:.17g}" for value in np.ravel(array))


def write_stamps(path, offset_ns, blank=()):
    lines = [
        "" if frame in blank else stamp_text(stamp_ns(frame) + offset_ns)
        for frame in range(NUM_LINES)
    ]
    path.write_text("\n".join(lines) + "\n")


def write_oxts(drive, frames, offset_ns, speed_m_s=15.0, yaw=0.3):
    """A straight drive at constant speed along the heading, on the Mercator plane."""
    (drive / "oxts" / "data").mkdir(parents=True)
    write_stamps(drive / "oxts" / "timestamps.txt", offset_ns)
    scale = np.cos(np.deg2rad(49.0)) * 6_378_137.0
    start = scale * np.log(np.tan(np.deg2rad(90 + 49.0) / 2))
    for frame in frames:
        # Latitude of the first record is 49 deg exactly, so that it gives the scale.
        metres = speed_m_s * (frame - frames[0]) * PERIOD_NS / 1e9
        north = start + metres * np.sin(yaw)
        lat = np.rad2deg(2 * np.arctan(np.exp(north / scale))) - 90
        lon = 8.4 + np.rad2deg(metres * np.cos(yaw) / scale)
        values = [lat, lon, 114.5, 0.02, -0.01, yaw, *np.zeros(24)]
        (drive / "oxts" / "data" / f"{frame:010d}.txt").write_text(words(values))


@pytest.fixture
def tree(tmp_path):
    """A drive of three sweeps with two cameras (one gray) and oxts."""
    date, drive = tmp_path / "2011_09_26", tmp_path / "2011_09_26" / "2011_09_26_drive_0099_sync"
    velodyne = drive / "velodyne_points"
    (velodyne / "data").mkdir(parents=True)
    rng = np.random.default_rng(0)
    points = {f: rng.uniform(0.05, 1, (7, 4)).astype("<f4") * [30, 9, 2, 1] for f in FRAMES}
    for frame, columns in points.items():
        points[frame] = columns.astype("<f4")
        (velodyne / "data" / f"{frame:010d}.bin").write_bytes(points[frame].tobytes())
    for name, offset in (("", 0), ("_start", -51_750_003), ("_end", 51_750_003)):
        write_stamps(velodyne / f"timestamps{name}.txt", offset, blank=(4,))

    P2, P0 = np.zeros((3, 4)), np.zeros((3, 4))
    P2[:, :3] = P0[:, :3] = K
    P2[:, 3] = K @ OFFSET_02
    (date / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        f"R_rect_00: {words(R_RECT)}\n"
        f"S_rect_00: {words(SIZE)}\nP_rect_00: {words(P0)}\n"
        f"S_rect_02: {words(SIZE)}\nP_rect_02: {words(P2)}\n"
    )
    (date / "calib_velo_to_cam.txt").write_text(
        f"calib_time: x\nR: {words(R_VELO_TO_CAM)}\nT: {words(T_VELO_TO_CAM)}\n"
    )
    (date / "calib_imu_to_velo.txt").write_text(
        f"R: {words(T_LIDAR_IMU[:3, :3])}\nT: {words(T_LIDAR_IMU[:3, 3])}\n"
    )
    rgb = rng.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8)
    gray = rng.integers(0, 256, (SIZE[1], SIZE[0]), dtype=np.uint8)
    for name, image in (("image_00", gray), ("image_02", rgb[:, :, ::-1])):
        (drive / name / "data").mkdir(parents=True)
        for frame in (2, 3):
            cv2.imwrite(str(drive / name / "data" / f"{frame:010d}.png"), image)
    write_stamps(drive / "image_02" / "timestamps.txt", KITTI_TRIGGER_LATENCY_NS + 5, blank=(5,))
    (drive / "image_03").mkdir()  # not in the calibration
    write_oxts(drive, (1, 2, 3, 4, 5), 17_000_000)
    return SimpleNamespace(
        drive=drive,
        date=date,
        points=points,
        rgb=rgb,
        gray=gray,
        calib=date / "calib_cam_to_cam.txt",
        bin=velodyne / "data" / "0000000003.bin",
    )


# Reading back exactly


def test_sweep_reads_back_exactly(tree):
    sequence = KittiRaw(tree.drive)
    assert sequence.name == "2011_09_26_drive_0099_sync"
    stamp = sequence[3].stamp_ns
    assert stamp == stamp_ns(3) == 1317042651_468_569_638
    assert int(float(stamp)) != stamp  # a float would have lost it
    assert tuple(sequence.frames) == FRAMES
    assert sequence.truth is None
    for frame in FRAMES:
        sweep = sequence[frame]
        np.testing.assert_array_equal(sweep.points, tree.points[frame][:, :3])
        np.testing.assert_array_equal(sweep.intensity, tree.points[frame][:, 3])
        np.testing.assert_array_equal(sweep.row, np.arange(7))
        assert (sweep.points.dtype, sweep.intensity.dtype) == (np.float64, np.float32)
        assert (sweep.row.dtype, sweep.lidar.dtype) == (np.int64, np.uint8)
        assert sweep.frame == frame


def test_start_and_end_of_sweeps_suffice_for_their_stamps(tree):
    (tree.drive / "velodyne_points" / "timestamps.txt").unlink()
    sequence = KittiRaw(tree.drive)
    assert sequence[3].stamp_ns == stamp_ns(3) and sequence[3].offset_ns is not None
    assert any("no timestamps.txt" in text for text in sequence.gaps())
    assert not any("100 ms" in text for text in sequence.gaps())
    (tree.drive / "velodyne_points" / "timestamps_end.txt").unlink()
    assert KittiRaw(tree.drive).stamp_ns(3) == 300_000_000


def test_two_files_of_one_number_are_refused(tree):
    (tree.bin.parent / "3.bin").write_bytes(tree.bin.read_bytes())
    with pytest.raises(InputError, match=r"has the number 3, as .*3\.bin has"):
        KittiRaw(tree.drive)


def test_an_image_in_two_formats_is_one(tree):
    png = tree.drive / "image_02" / "data" / "0000000003.png"
    cv2.imwrite(str(png.with_suffix(".jpg")), np.zeros_like(tree.rgb))
    np.testing.assert_array_equal(KittiRaw(tree.drive).image("image_02", 3), tree.rgb)


def test_firing_times_follow_the_azimuth_clockwise(tree):
    angle = np.deg2rad([0, 90, -90, 179.9, -179.9])
    columns = np.zeros((5, 4), "<f4")
    columns[:, 0], columns[:, 1] = 10 * np.cos(angle), 10 * np.sin(angle)
    tree.bin.write_bytes(columns.tobytes())
    offset = KittiRaw(tree.drive)[3].offset_ns
    revolution_ns = 2 * 51_750_003
    expected = revolution_ns * np.array([0, -0.25, 0.25, -0.49972, 0.49972])
    assert offset.dtype == np.int64
    np.testing.assert_allclose(offset, expected, atol=1000)  # left is seen before forward


def test_invalid_rows_are_dropped_and_the_rest_keep_their_row(tree):
    columns = np.ones((8, 4), "<f4") * np.arange(1, 9, dtype="<f4")[:, None]
    columns[0] = 0
    columns[2, 1] = np.nan
    columns[3, 3] = np.nan
    columns[4, :3] = 0  # at the origin, with a reflectance
    columns[5, 0] = np.inf
    columns[6, :2] = 0  # straight up is a place
    columns[7] = 0
    tree.bin.write_bytes(columns.tobytes())
    sweep = KittiRaw(tree.drive)[3]
    np.testing.assert_array_equal(sweep.row, [1, 3, 6])
    np.testing.assert_array_equal(sweep.points, columns[[1, 3, 6], :3])
    np.testing.assert_array_equal(sweep.intensity, [2, 0, 7])  # 0 where there is none
    assert sweep.offset_ns.shape == (3,)


def test_cameras_project_as_the_calibration_chain_says(tree):
    cameras = KittiRaw(tree.drive).cameras
    assert list(cameras) == ["image_00", "image_02"]
    camera = cameras["image_02"]
    assert (camera.width_px, camera.height_px) == SIZE
    assert camera.distortion == ()
    point = np.array([12.0, 1.5, -0.7])
    rectified = R_RECT @ (R_VELO_TO_CAM @ point + T_VELO_TO_CAM)
    P = np.hstack([K, (K @ OFFSET_02)[:, None]])
    expected = P @ np.append(rectified, 1)
    got = camera.K @ poses.transform(camera.T_cam_lidar, point[None])[0]
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_image_stamps_are_those_of_the_exposure(tree):
    cv2.imwrite(str(tree.drive / "image_02" / "data" / "0000000005.png"), tree.rgb)
    sequence = KittiRaw(tree.drive)
    assert sequence.image_stamps_ns("image_02")[3] == stamp_ns(3) + 5
    assert sequence.image_stamps_ns("image_02")[5] == stamp_ns(5)  # none recorded
    assert sequence.image_stamps_ns("image_00")[3] == stamp_ns(3)  # no file at all


def test_a_drive_of_sweeps_alone_opens(tree):
    for path in tree.date.glob("calib*.txt"):
        path.unlink()
    for folder in tree.drive.glob("image_*"):
        folder.rename(tree.date / folder.name)
    (tree.drive / "oxts").rename(tree.date / "oxts")
    sequence = KittiRaw(tree.drive)
    assert dict(sequence.cameras) == {}
    assert len(sequence[2]) == 7
    assert "cameras" in describe(sequence)


# Poses


def test_poses_are_interpolated_to_the_sweep(tree):
    """Constant speed: each step is speed times the time between sweeps, whatever the oxts lag."""
    sequence = KittiRaw(tree.drive)
    T_2, T_3, T_5 = (sequence.T_world_lidar(frame) for frame in (2, 3, 5))
    step = 15.0 * PERIOD_NS / 1e9
    np.testing.assert_allclose(np.linalg.norm((T_3 - T_2)[:3, 3]), step, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm((T_5 - T_3)[:3, 3]), 2 * step, atol=1e-5)
    # Sweep 3 comes 17 ms before its record: behind it by that much of the way.
    record = sequence._T_world_imu(3) @ poses.inverse(T_LIDAR_IMU)
    np.testing.assert_allclose(
        poses.inverse(record) @ T_3 @ [0, 0, 0, 1],
        poses.inverse(record) @ (record + (T_2 - T_3) * 17e6 / PERIOD_NS) @ [0, 0, 0, 1],
        atol=1e-5,
    )


# --- everything that can be wrong -----------------------------------------------------------------


def stamps_of(tree, name=""):
    return tree.drive / "velodyne_points" / f"timestamps{name}.txt"


def without_line(path, text=""):
    """With another text for the line of frame 3."""
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:3], text, *lines[4:]]))


def calibration(key, value):
    def harm(tree):
        lines = [x for x in tree.calib.read_text().splitlines() if not x.startswith(key)]
        tree.calib.write_text("\n".join([*lines, *([f"{key}: {value}"] if value else [])]))

    return harm


def oxts(text):
    return lambda tree: (tree.drive / "oxts/data/0000000003.txt").write_text(text)


def image(data):
    return lambda tree: (tree.drive / "image_02/data/0000000002.png").write_bytes(data)


OTHER_SIZE = cv2.imencode(".png", np.zeros((SIZE[1], SIZE[0] - 1, 3), np.uint8))[1].tobytes()
WRONG = [
    (lambda t: shutil.rmtree(t.drive / "velodyne_points"), "no sweeps.*.bin"),
    (lambda t: t.bin.write_bytes(t.bin.read_bytes()[:-5]), "got 107 bytes.*multiple of 16"),
    (lambda t: t.bin.write_bytes(bytes(48)), "holds no points.*frame 3"),
    (lambda t: (t.date / "calib_cam_to_cam.txt").unlink(), "cam_to_cam.txt: missing"),
    (lambda t: (t.date / "calib_imu_to_velo.txt").unlink(), "imu_to_velo.txt: missing"),
    (calibration("R_rect_00", None), "no key R_rect_00"),
    (calibration("R_rect_00", "1 0 0 0 1 0 0 0"), "R_rect_00: got 8 values, expected 9"),
    (calibration("R_rect_00", "1 0 0 0 one 0 0 0 1"), "R_rect_00: .*'one'"),
    (calibration("R_rect_00", "1 0 0 0 1 0 0 0 1.01"), "R_rect_00: .*not a rotation"),
    (calibration("P_rect_02", words(np.zeros(12))), "P_rect_02.*positive focal lengths"),
    (lambda t: shutil.rmtree(t.drive / "oxts"), "no poses.*register.source=kiss-icp"),
    (lambda t: (t.drive / "oxts/data/0000000003.txt").unlink(), "no oxts record.*3.* 1-2, 4-5"),
    (oxts(words([91, *np.zeros(29)])), "latitude of 91"),
    (lambda t: without_line(stamps_of(t), "2262-09-26 13:10:51"), "no stamp of frame 3.*0-2, 5-7"),
    (lambda t: without_line(stamps_of(t, "_start")), "_start.txt: no stamp of frame 3"),
    (lambda t: stamps_of(t).write_text("\n1317042651.1\n"), "got '1317042651.1'.* 1970 to 2261"),
    (lambda t: write_stamps(stamps_of(t, "_end"), -60_000_000), "frame 3 ends .* before it starts"),
    (image(b""), r"0000000002.png.*0 bytes.*PNG or JPEG"),
    (image(OTHER_SIZE), "39 x 20 px; expected 40 x 20.*image_02"),
]


@pytest.mark.parametrize(("harm", "says"), WRONG, ids=[says for _, says in WRONG])
def test_whatever_is_wrong_is_refused_in_a_line(tree, harm, says):
    harm(tree)
    with pytest.raises(InputError, match=says) as error:
        sequence = KittiRaw(tree.drive)
        sequence[3]
        sequence.T_world_lidar(3)
        sequence.image("image_02", 2)
    assert "\n" not in str(error.value) and str(tree.date) in str(error.value)


def test_what_is_not_there_is_named_with_what_is(tree):
    sequence = KittiRaw(tree.drive)
    for ask in (sequence.__getitem__, sequence.T_world_lidar):
        with pytest.raises(InputError, match=r"frame 4; .*2-3, 5"):
            ask(4)
    with pytest.raises(InputError, match=r"'image_03'.*image_00, image_02"):
        sequence.image("image_03", 2)
    with pytest.raises(InputError, match=r"no image_02 image of frame 5; .* 2-3"):
        sequence.image("image_02", 5)


def test_a_line_that_is_no_stamp_costs_its_frame_alone(tree):
    whole = KittiRaw(tree.drive)
    without_line(stamps_of(tree), "yesterday")
    without_line(tree.drive / "oxts" / "timestamps.txt", "yesterday")
    sequence = KittiRaw(tree.drive)
    assert sequence.stamp_ns(5) == whole.stamp_ns(5)
    np.testing.assert_allclose(sequence.T_world_lidar(2), whole.T_world_lidar(2), atol=1e-3)


# What people see


def test_description_of_a_drive(tree):
    lines = describe(KittiRaw(tree.drive)).splitlines()
    table = {line.split("  ")[0]: line.split("  ", 1)[1].strip() for line in lines}
    assert table["name"] == "2011_09_26_drive_0099_sync"
    assert table["frames"] == "2-3, 5 (3, 1 missing between them)"
    assert table["rate"] == "9.66 Hz"
    assert table["points"] == "7 in frame 2, 7 in frame 5"
    assert table["image_02"] == "40 x 20 px, fx 50.0 px, rectified, 2 images: 2-3, 9.66 Hz"
    assert table["poses"] == "yes, a path of 4.7 m"
    assert table["truth"] == "none"
    assert str(stamp_ns(2)) in table["stamps"]
    starts = {len(line) - len(line.split("  ", 1)[1].lstrip()) for line in lines}
    assert len(starts) == 1  # aligned


# Real drives


DRIVES = "kitti/2011_09_26/2011_09_26_drive_{}_sync"


@pytest.mark.parametrize(
    ("drive", "frames", "cameras"),
    [("0013", range(96, 136), ["image_02"]), ("0002", range(10), ["image_02", "image_03"])],
)
def test_real_drive(test_data, drive, frames, cameras):
    """Of whole drives or of excerpts that have these."""
    sequence = KittiRaw(test_data / DRIVES.format(drive))
    assert {*frames} <= {*sequence.frames} and {*cameras} <= {*sequence.cameras}
    sweep = sequence[frames[5]]
    assert 110_000 < len(sweep) < 130_000
    assert np.abs(sweep.offset_ns).max() < 52_000_000
    assert np.ptp(sweep.offset_ns) > 100_000_000
    for name in cameras:
        camera = sequence.cameras[name]
        assert sequence.image(name, frames[5]).shape == (375, 1242, 3)
        lag_ns = sequence.image_stamps_ns(name)[frames[5]] - sweep.stamp_ns
        assert abs(lag_ns) < 1_000_000
        p = poses.transform(camera.T_cam_lidar, sweep.points)
        u, v, _ = (camera.K @ p[p[:, 2] > 1].T) / p[p[:, 2] > 1, 2]
        inside = (abs(u - 621) < 621) & (abs(v - 187) < 187)
        assert 15_000 < inside.sum() < 25_000
        assert np.median(v[inside]) > 187  # mostly road, below the horizon
