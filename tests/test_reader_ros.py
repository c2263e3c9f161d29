# SPDX-License-Identifier: MIT
"""ROS bags: a street written as each kind, messages of every layout, frames, and damage."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from ros_bags import PERIOD_NS, STAMP_NS, Maker, scan
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.readers import open_sequence
from densify.readers.ros import RosBag
from tests.reader_checks import check_cameras, check_refused, check_sweeps, check_truth

pytest.importorskip("rosbags")

HALF_NS = 50_000_000
POINTS = np.column_stack([scan()[axis] for axis in "xyz"]).astype(float)


@pytest.mark.parametrize("format", ["ros1", "ros2"])
def test_the_street_is_given_back(format, recorded, excerpt):
    sequence = open_sequence(recorded(format))
    assert isinstance(sequence, RosBag)
    check_sweeps(sequence, excerpt, -HALF_NS)
    check_cameras(sequence, excerpt)
    check_truth(sequence, excerpt)


# Points


@pytest.mark.parametrize("driver", ["hesai", "big-endian"])
def test_layouts_and_times_of_drivers(driver, tmp_path):
    """Absolute seconds, and microseconds of wide points; rows are padded."""
    columns, maker = scan(), Maker()
    fired_ns = columns.pop("t").astype(np.int64)
    for stamp_ns in (STAMP_NS, STAMP_NS + PERIOD_NS):
        if driver == "hesai":
            columns["timestamp"] = (stamp_ns + fired_ns) * 1e-9
        else:
            columns["time_offset"] = (fired_ns // 1000).astype("u4")
            columns["x"] = columns["x"].astype("f8")
        maker.cloud(columns, stamp_ns, height=4, row_padding=5, big=driver == "big-endian")
    sequence = open_sequence(maker.write(tmp_path))
    words = {"hesai": "timestamp in s, absolute", "big-endian": "time_offset in us, relative"}
    assert words[driver] in dict(sequence.findings())["times"]
    assert np.abs(sequence[0].offset_ns - fired_ns).max() <= 1200
    np.testing.assert_allclose(sequence[0].points[:, 1], scan()["y"], rtol=1e-7)


def test_definitions_in_a_bag_are_not_made_code_of(tmp_path, monkeypatch):
    maker = Maker(".bag")
    maker.sweeps(2)
    text = "float32 no_such_field\nimport os"
    monkeypatch.setattr(maker.types, "generate_msgdef", lambda _: (text, "0" * 32))
    assert len(open_sequence(maker.write(tmp_path))[1]) == 60


def test_a_livox_message(tmp_path):
    maker, package = Maker(".bag"), "livox_ros_driver2/msg"
    points = [
        maker.make(f"{package}/CustomPoint", 990_000 * i, 5.0, 0.1 * i, 1.0, 51, 16, i % 6)
        for i in range(100)
    ]
    for stamp_ns in (STAMP_NS, STAMP_NS + PERIOD_NS):
        values = (maker.header(stamp_ns, "livox_frame"), stamp_ns, 100, 0, np.zeros(3, np.uint8))
        maker.put("/livox/lidar", f"{package}/CustomMsg", stamp_ns, *values, points)
    sweep = open_sequence(maker.write(tmp_path))[1]
    np.testing.assert_array_equal(sweep.offset_ns, 990_000 * np.arange(100))
    np.testing.assert_allclose(sweep.points[:, 1], 0.1 * np.arange(100), rtol=1e-6)
    assert sweep.intensity[0] == np.float32(0.2)


def pose(yaw_deg, *position_m):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    T[:3, 3] = position_m
    return T


def test_several_lidars_make_one_sweep(tmp_path):
    maker, late_ns = Maker(), 20_000_000
    maker.sweeps(3, topic="/top/points", frame="top")
    maker.sweeps(3, STAMP_NS + late_ns, topic="/side/points", frame="/side")
    maker.transform("base", "top", pose(0, 1.0, 0, 1.8))
    maker.transform("base", "side", pose(90, 0.5, 0.9, 1.0))
    place = maker.write(tmp_path)
    with pytest.raises(InputError, match=r"could be the sweeps: /side/points \(PointCloud2, 3\)"):
        open_sequence(place)
    assert len(open_sequence(f"ros:{place}#points=/side/points")[0]) == 60
    sweep = open_sequence(f"ros:{place}#points=/top/points,/side/points")[1]
    assert np.bincount(sweep.lidar).tolist() == [60, 60]
    np.testing.assert_allclose(sweep.scanner_origins, [[0, 0, 0], [-0.5, 0.9, -0.8]], atol=1e-9)
    T_top_side = inverse(pose(0, 1.0, 0, 1.8)) @ pose(90, 0.5, 0.9, 1.0)
    np.testing.assert_allclose(sweep.points[60:], transform(T_top_side, POINTS), atol=1e-9)
    np.testing.assert_array_equal(sweep.offset_ns[60:], scan()["t"].astype(int) + late_ns)


# Images

T_CAM_LIDAR = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])
PIXELS = np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)
GRAY = PIXELS[:, :, 0]


def with_cameras(*cameras):
    """cameras: stored pixels, encoding, topic and changes of the calibration of each."""
    maker = Maker()
    maker.sweeps(2)
    for data, encoding, topic, info in cameras:
        maker.image(data, encoding, topic, step=data[0].nbytes + 5)
        maker.info(f"{topic.rpartition('/')[0]}/camera_info", **info)
    maker.transform("lidar", "front_optical", inverse(T_CAM_LIDAR))
    return maker


def with_camera(encoding="rgb8", info=None):
    return with_cameras((PIXELS, encoding, "/front/image_raw", info or {}))


def test_encodings(tmp_path):
    stored = {
        "rgb8": PIXELS,
        "bgra8": np.dstack([PIXELS[:, :, ::-1], GRAY]),
        "mono16": GRAY.astype("<u2") * 256 + 7,
        "bayer_rggb8": np.tile(np.array([[200, 100], [100, 30]], np.uint8), (3, 4)),
        "bayer_gbrg8": np.tile(np.array([[100, 30], [200, 100]], np.uint8), (3, 4)),
    }
    cameras = [(data, encoding, f"/{encoding}/image_raw", {}) for encoding, data in stored.items()]
    sequence = open_sequence(with_cameras(*cameras).write(tmp_path))
    for encoding in stored:
        assert sequence.image_stamps_ns(encoding) == {0: STAMP_NS + 1}
        np.testing.assert_allclose(sequence.cameras[encoding].T_cam_lidar, T_CAM_LIDAR, atol=1e-12)
        rgb = sequence.image(encoding, 0)
        if "bayer" in encoding:
            assert np.abs(rgb[2:4, 2:6].astype(int) - [200, 100, 30]).max() <= 1
        else:
            seen = np.dstack([GRAY] * 3) if encoding == "mono16" else PIXELS
            np.testing.assert_array_equal(rgb, seen)


INFOS = {  # changes of the calibration; model, number of coefficients, fx of the camera
    "raw": ({"d": [0.1, -0.2, 0.01, 0.02, 0.03]}, "pinhole", 5, 100.0),
    "rational": ({"d": [0.1] * 8, "model": "rational_polynomial"}, "pinhole", 8, 100.0),
    "fisheye": ({"d": [0.0] * 4, "model": "equidistant"}, "fisheye", 4, 100.0),
    "rect": ({"d": [0.1] * 5}, "pinhole", 0, 90.0),
    # A pixel of the image is 2 x 2 of the sensor, from (10, 4) on.
    "binned": (
        {"size": (100, 100), "binning": (2, 2), "roi": (10, 4, 12, 16), "d": [0.0] * 5},
        *("pinhole", 0, 50.0),
    ),
}


def test_calibrations(tmp_path):
    R = Rotation.from_euler("x", 3, degrees=True).as_matrix()
    cameras = [
        (PIXELS, "rgb8", f"/{kind}/image_{kind}", {"r": R.ravel(), **info})
        for kind, (info, *_) in INFOS.items()
    ]
    read = open_sequence(with_cameras(*cameras).write(tmp_path)).cameras
    for kind, (_, *expected) in INFOS.items():
        camera = read[kind]
        assert [camera.model, len(camera.distortion), camera.K[0, 0]] == expected
        T = T_CAM_LIDAR.copy()
        T[:3] = (R if kind == "rect" else np.eye(3)) @ T[:3]
        np.testing.assert_allclose(camera.T_cam_lidar, T, atol=1e-12)
    assert (read["binned"].width_px, read["binned"].height_px) == (8, 6)
    # the sensor's pixel 3.5 is -6.5 of the part: its binned pixel's centre is at (-6.5 - 0.5) / 2
    np.testing.assert_allclose(read["binned"].K[:2], [[50, 0, -3.5], [0, 55, -1.0]])


def test_compressed_images_and_the_best_of_several(tmp_path):
    maker = with_camera()
    data = cv2.imencode(".png", PIXELS[:, :, ::-1])[1].tobytes()
    for topic in ("/front/image_rect_color", "/depth/image_raw", "/rear/image_raw"):
        maker.compressed(data, f"{topic}/compressed")
    maker.compressed(b"\x00\x00\x00\x01video", "/video/image_raw/compressed")
    maker.info("/video/camera_info")
    place = maker.write(tmp_path)
    sequence = open_sequence(place)
    assert set(sequence.cameras) == {"front"}
    assert sequence.cameras["front"].K[0, 0] == 90  # P
    np.testing.assert_array_equal(sequence.image("front", 0), PIXELS)
    unusable = " ".join(text for label, text in sequence.findings() if label == "no camera")
    assert "/rear/image_raw/compressed: no /rear/camera_info" in unusable
    assert "expected JPEG or PNG" in unusable
    named = open_sequence(f"ros:{place}#images=/front/image_raw")
    assert named.cameras["front"].K[0, 0] == 100
    assert not open_sequence(f"ros:{place}#images=none").cameras


# Poses

T_BASE_LIDAR = pose(90, 1.0, 0.2, 1.7)


def driven(record):
    """Poses every 50 ms around two sweeps, the first of which lies halfway between two of them."""
    maker = Maker()
    maker.sweeps(2)
    maker.transform("base", "lidar", T_BASE_LIDAR)
    for i in range(-2, 6):
        record(maker, i, STAMP_NS + 25_000_000 + i * 50_000_000)
    return maker


def at(i):
    return pose(2.0 * i, 0.5 * i, 0.1, 0.0)


def test_odometry_is_brought_to_the_lidar(tmp_path):
    place = driven(lambda maker, i, ns: maker.odometry(at(i), ns)).write(tmp_path)
    sequence = open_sequence(place)
    np.testing.assert_allclose(sequence.T_world_lidar(0), at(-0.5) @ T_BASE_LIDAR, atol=1e-3)
    assert "/odom, 8 of them" in dict(sequence.findings())["poses from"]
    with pytest.raises(InputError, match="no poses"):
        open_sequence(f"ros:{place}#poses=none").T_world_lidar(0)


def test_registered_clouds_are_taken_back_out_of_the_world_of_their_odometry(tmp_path):
    maker, T = Maker(), pose(30.0, 4.0, -2.0, 0.5)
    placed = transform(T, POINTS).astype(np.float32)
    for i in range(3):
        maker.cloud(dict(zip("xyz", placed.T, strict=True)), STAMP_NS + i * PERIOD_NS, frame="odom")
        maker.odometry(T, STAMP_NS + i * PERIOD_NS, child="body")
    sequence = open_sequence(maker.write(tmp_path))
    np.testing.assert_allclose(sequence[1].points, POINTS, atol=1e-4)
    np.testing.assert_allclose(sequence.T_world_lidar(1), T, atol=1e-9)
    assert "out of the world of /odom" in dict(sequence.findings())["lidar"]


def test_transforms_are_poses_and_the_smooth_frame_is_the_world(tmp_path):
    def record(maker, i, stamp_ns):
        maker.transform("odom", "base", at(i), "/tf", stamp_ns)
        maker.transform("map", "odom", pose(0, 5.0 * (i > 2), 0, 0), "/tf", stamp_ns)
        maker.transform("base", "mast", pose(0, 0, 0, 2.0), "/tf", stamp_ns)  # published, but fixed

    sequence = open_sequence(driven(record).write(tmp_path))
    np.testing.assert_allclose(sequence.T_world_lidar(0), at(-0.5) @ T_BASE_LIDAR, atol=1e-3)
    assert dict(sequence.findings())["poses from"] == "/tf, odom to lidar"
    T_mast_lidar = pose(0, 0, 0, -2.0) @ T_BASE_LIDAR
    between = sequence._transforms.between("mast", "lidar")
    np.testing.assert_allclose(between, T_mast_lidar, atol=1e-9)


# Damage


def bad_cloud(**changes):
    maker = Maker()
    maker.sweeps(2)
    for name, value in changes.items():
        object.__setattr__(maker.written[1].message, name, value)
    return maker


def unplaced():
    maker = with_camera()
    maker.written = [record for record in maker.written if record.topic != "/tf_static"]
    return maker


RAW = "#images=/front/image_raw"
BAGS = {
    "got topic, expected #points=": (bad_cloud, "#topic=/a"),
    "no such topic; topics that fit: /points": (bad_cloud, "#points=/other"),
    "got 99 bytes and rows of": (lambda: bad_cloud(data=np.zeros(99, np.uint8)), ""),
    "got the encoding 32FC1, expected one of rgb8": (lambda: with_camera("32FC1"), RAW),
    "joins the camera's frame front_optical": (unplaced, RAW),
    "says binning 2, but the images": (lambda: with_camera(info={"binning": (2, 2)}), ""),
    "model 'ftheta', expected": (lambda: with_camera(info={"model": "ftheta", "d": [1.0]}), RAW),
}


@pytest.mark.parametrize("says", BAGS)
def test_bad_bags_are_refused_in_a_line(says, tmp_path):
    """Cameras that are not asked for are left out, with the same words in `info`."""
    make, options = BAGS[says]
    place = make().write(tmp_path)
    check_refused(f"ros:{place}{options}", says, place, frame=1)
    if options == RAW:
        sequence = open_sequence(place)
        assert not sequence.cameras and says in dict(sequence.findings())["no camera"]


def test_messages_recorded_twice_are_read_once_and_late_ones_in_order(tmp_path):
    maker = Maker()
    for i in (0, 1, 3, 2, 2, 4):
        maker.cloud(scan(60 + i), STAMP_NS + i * PERIOD_NS)
    sequence = open_sequence(maker.write(tmp_path))
    stamps_ns = [sequence.stamp_ns(frame) for frame in sequence.frames]
    assert stamps_ns == [STAMP_NS + i * PERIOD_NS for i in range(5)]
    assert [len(sequence[f]) for f in sequence.frames] == [60, 61, 62, 63, 64]
    assert sequence.gaps() == ["/points: 1 messages were recorded twice and are read once"]


def test_what_drivers_leave_at_zero(tmp_path):
    """The step of an only row, and stamps: then those of the recording are taken."""
    sequence = open_sequence(bad_cloud(row_step=0).write(tmp_path / "row"))
    np.testing.assert_array_equal(sequence[1].points[:, 0].astype("f4"), scan()["x"])
    maker = Maker()
    for i in range(2):
        maker.cloud(scan(), 0)
        maker.written[-1] = maker.written[-1]._replace(log_ns=STAMP_NS + i * PERIOD_NS)
    sequence = open_sequence(maker.write(tmp_path))
    assert [sequence.stamp_ns(f) for f in (0, 1)] == [STAMP_NS, STAMP_NS + PERIOD_NS]
    told = "/points: 2 headers have no stamp: taken is when they were recorded"
    assert sequence.gaps() == [told]


def test_files_compressed_as_a_whole(tmp_path):
    """The folder is read by its metadata; a file alone cannot be."""
    maker = Maker(".mcap")
    maker.sweeps(2)
    place = maker.write(tmp_path, compressed=True)
    (file,) = place.glob("*.zstd")
    np.testing.assert_array_equal(open_sequence(place)[1].points[:, 0].astype("f4"), scan()["x"])
    with pytest.raises(InputError, match=rf"decompress it by zstd -d {file.name} and name"):
        open_sequence(file)
    (place / "metadata.yaml").unlink()
    with pytest.raises(InputError, match="name the bag's folder with its metadata"):
        open_sequence(place)


def test_an_mcap_of_other_messages_is_not_called_broken(tmp_path):
    mcap_writer = pytest.importorskip("mcap.writer")
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = mcap_writer.Writer(file)
        writer.start("px4", "test")
        schema = writer.register_schema("thing", "jsonschema", b"{}")
        channel = writer.register_channel("/thing", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(InputError, match="is a whole MCAP file with messages of px4") as error:
        open_sequence(tmp_path / "a.mcap")
    assert "mended" not in str(error.value)


@pytest.mark.parametrize("suffix", [".db3", ".mcap", ".bag"])
def test_whole_bags_are_read_and_cut_off_ones_refused_in_a_line(suffix, tmp_path):
    maker = Maker(suffix)
    maker.sweeps(40)
    place = maker.write(tmp_path)
    file = place if place.is_file() else next(place.glob(f"*{suffix}"))
    for path in (place, file):
        sequence = open_sequence(path)
        assert len(sequence.frames) == 40
        assert sequence.stamp_ns(2) == STAMP_NS + 2 * PERIOD_NS
        np.testing.assert_array_equal(sequence[1].points[:, 0].astype("f4"), scan()["x"])
        np.testing.assert_array_equal(sequence[1].offset_ns, scan()["t"])
        assert sequence[1].intensity.max() == np.float32(59 / 255)
        findings = dict(sequence.findings())
        assert findings["times"].startswith("t in ns, relative")
        assert "ring = ring" in findings["lidar"] and findings["poses from"].startswith("none")
    data = file.read_bytes()
    for num_bytes in (0, len(data) // 2):
        file.write_bytes(data[:num_bytes])
        with pytest.raises(InputError) as error:
            sequence = open_sequence(f"ros:{place}")
            for frame in range(40):
                sequence[frame]
        message = str(error.value)
        assert message.startswith(f"{place}: ") and "\n" not in message
