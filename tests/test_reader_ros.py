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
from tests.command import exit_code
from tests.reader_checks import check_cameras, check_refused, check_sweeps, check_truth

pytest.importorskip("rosbags")

HALF_NS = 50_000_000


@pytest.mark.parametrize("format", ["ros1", "ros2"])
def test_the_street_is_given_back(format, recorded, excerpt):
    sequence = open_sequence(recorded(format))
    assert isinstance(sequence, RosBag)
    check_sweeps(sequence, excerpt, -HALF_NS)
    check_cameras(sequence, excerpt)
    check_truth(sequence, excerpt)


# Points


@pytest.mark.parametrize("suffix", [".db3", ".mcap", ".bag"])
def test_bags_of_every_kind(suffix, tmp_path):
    maker = Maker(suffix)
    maker.sweeps(3)
    place = maker.write(tmp_path)
    files = [place, *(place.glob(f"*{suffix}") if place.is_dir() else [tmp_path])]
    for path in files:
        sequence = open_sequence(path)
        assert list(sequence.frames) == [0, 1, 2]
        assert sequence.stamp_ns(2) == STAMP_NS + 2 * PERIOD_NS
        sweep = sequence[1]
        np.testing.assert_array_equal(sweep.points[:, 0].astype("f4"), scan()["x"])
        np.testing.assert_array_equal(sweep.offset_ns, scan()["t"])
        assert sweep.intensity.max() == np.float32(59 / 255)
        found = dict(sequence.findings())
        assert found["times"].startswith("t in ns, relative")
        assert "ring = ring" in found["lidar"] and found["poses from"].startswith("none")


TIMES = {
    "velodyne": ("time", lambda t: (t * 1e-9).astype("f4"), "time in s, relative"),
    "hesai": ("timestamp", lambda t: (STAMP_NS + t) * 1e-9, "timestamp in s, absolute"),
    "ns since 1970": ("timestamp", lambda t: (STAMP_NS + t).astype("f8"), "timestamp in ns, absol"),
    "us": ("time_offset", lambda t: (t // 1000).astype("u4"), "time_offset in us, relative"),
    "ms": ("t", lambda t: (t * 1e-6).astype("f4"), "t in ms, relative"),
}


@pytest.mark.parametrize("driver", TIMES)
def test_layouts_and_times_of_drivers(driver, tmp_path):
    name, make, words = TIMES[driver]
    fired_ns = scan()["t"].astype(np.int64)
    big = driver == "us"
    columns = {k: v for k, v in scan().items() if k != "t"} | {name: make(fired_ns)}
    columns |= {"x": columns["x"].astype("f8")} if driver == "ms" else {}
    maker = Maker()
    for i in range(2):
        # times that are absolute go on with the sweeps
        later = {
            n: c + (i * PERIOD_NS * 1e-9 if driver == "hesai" else 0) for n, c in columns.items()
        }
        kept = columns if driver != "hesai" else columns | {name: later[name]}
        maker.cloud(kept, STAMP_NS + i * PERIOD_NS, height=4, row_padding=5, big=big)
    sequence = open_sequence(maker.write(tmp_path))
    assert words in dict(sequence.findings())["times"]
    sweep = sequence[0]
    assert np.abs(sweep.offset_ns - fired_ns).max() <= 1200
    np.testing.assert_allclose(sweep.points[:, 1], scan()["y"], rtol=1e-7)


def test_definitions_in_a_bag_are_not_made_code_of(tmp_path, monkeypatch):
    maker = Maker(".bag")
    maker.sweeps(2)
    text = "float32 no_such_field\nimport os"
    monkeypatch.setattr(maker.types, "generate_msgdef", lambda _: (text, "0" * 32))
    assert len(open_sequence(maker.write(tmp_path))[1]) == 60


def test_a_livox_message(tmp_path):
    maker = Maker(".bag")
    points = [
        maker.make(
            "livox_ros_driver2/msg/CustomPoint", 990_000 * i, 5.0, 0.1 * i, 1.0, 51, 16, i % 6
        )
        for i in range(100)
    ]
    for i in range(2):
        stamp_ns = STAMP_NS + i * PERIOD_NS
        values = (maker.header(stamp_ns, "livox_frame"), stamp_ns, 100, 0, np.zeros(3, np.uint8))
        type_ = "livox_ros_driver2/msg/CustomMsg"
        maker.put("/livox/lidar", type_, maker.make(type_, *values, points), stamp_ns)
    sweep = open_sequence(maker.write(tmp_path))[1]
    np.testing.assert_array_equal(sweep.offset_ns, 990_000 * np.arange(100))
    np.testing.assert_allclose(sweep.points[:, 1], 0.1 * np.arange(100), rtol=1e-6)
    assert sweep.intensity[0] == np.float32(0.2)


def pose(yaw_deg, *place):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    T[:3, 3] = place
    return T


def two_lidars(late_ns=20_000_000):
    maker = Maker()
    maker.sweeps(3, topic="/top/points", frame="top")
    for i in range(3):
        maker.cloud(scan(), STAMP_NS + i * PERIOD_NS + late_ns, topic="/side/points", frame="/side")
    maker.transform("base", "top", pose(0, 1.0, 0, 1.8))
    maker.transform("base", "side", pose(90, 0.5, 0.9, 1.0))
    return maker


def test_several_lidars_make_one_sweep(tmp_path):
    place = two_lidars().write(tmp_path)
    with pytest.raises(
        InputError, match=r"several topics could be the sweeps: /side/points \(Poin"
    ):
        open_sequence(place)
    assert len(open_sequence(f"ros:{place}#points=/side/points")[0]) == 60
    sweep = open_sequence(f"ros:{place}#points=/top/points,/side/points")[1]
    assert np.bincount(sweep.lidar).tolist() == [60, 60]
    np.testing.assert_allclose(sweep.scanner_origins, [[0, 0, 0], [-0.5, 0.9, -0.8]], atol=1e-9)
    own = np.column_stack([scan()[axis] for axis in "xyz"]).astype(float)
    T_top_side = inverse(pose(0, 1.0, 0, 1.8)) @ pose(90, 0.5, 0.9, 1.0)
    np.testing.assert_allclose(sweep.points[60:], transform(T_top_side, own), atol=1e-9)
    np.testing.assert_array_equal(sweep.offset_ns[60:], scan()["t"].astype(int) + 20_000_000)


# Images

PIXELS = np.random.default_rng(1).integers(0, 256, (6, 8, 3), np.uint8)
GRAY = PIXELS[:, :, 0]
ALPHA = np.dstack([PIXELS, GRAY])
IMAGES = {  # encoding: what is stored, what is seen
    "rgb8": (PIXELS, PIXELS),
    "bgra8": (ALPHA, PIXELS[:, :, ::-1]),
    "mono16": (GRAY.astype("<u2") * 256 + 7, np.dstack([GRAY] * 3)),
}


def with_camera(encoding="rgb8", data=PIXELS, info=None, **options):
    maker = Maker()
    maker.sweeps(2)
    maker.image(data, encoding, **options)
    maker.info(**(info or {}))
    maker.transform("lidar", "front_optical", inverse(T_CAM_LIDAR))
    return maker


T_CAM_LIDAR = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, 0.3], [0, 0, 0, 1.0]])


@pytest.mark.parametrize("encoding", IMAGES)
def test_encodings(encoding, tmp_path):
    stored, seen = IMAGES[encoding]
    step = stored.nbytes // 6 + 5
    sequence = open_sequence(with_camera(encoding, stored, step=step).write(tmp_path))
    assert sequence.image_stamps_ns("front") == {0: STAMP_NS + 1}
    np.testing.assert_array_equal(sequence.image("front", 0), seen)
    np.testing.assert_allclose(sequence.cameras["front"].T_cam_lidar, T_CAM_LIDAR, atol=1e-12)


@pytest.mark.parametrize("pattern", ["rggb", "gbrg"])
def test_mosaics_have_the_right_colours(pattern, tmp_path):
    colour = {"r": 200, "g": 100, "b": 30}
    mosaic = np.array(
        [[colour[c] for c in pattern[:2]], [colour[c] for c in pattern[2:]]], np.uint8
    )
    place = with_camera(f"bayer_{pattern}8", np.tile(mosaic, (3, 4))).write(tmp_path)
    rgb = open_sequence(place).image("front", 0)
    assert np.abs(rgb[2:4, 2:6].astype(int) - [200, 100, 30]).max() <= 1


INFOS = {
    "raw": ({"d": [0.1, -0.2, 0.01, 0.02, 0.03]}, "image_raw", "pinhole", 5, 100.0),
    "rational": (
        {"d": [0.1] * 8, "model": "rational_polynomial"},
        "image_raw",
        "pinhole",
        8,
        100.0,
    ),
    "fisheye": ({"d": [0.0] * 4, "model": "equidistant"}, "image_raw", "fisheye", 4, 100.0),
    "rectified": ({"d": [0.1] * 5}, "image_rect_color", "pinhole", 0, 90.0),
}


@pytest.mark.parametrize("kind", INFOS)
def test_calibrations(kind, tmp_path):
    info, topic, model, num, fx = INFOS[kind]
    R = Rotation.from_euler("x", 3, degrees=True).as_matrix()
    info = {**info, "r": R.ravel()}
    place = with_camera(info=info, topic=f"/front/{topic}").write(tmp_path)
    camera = open_sequence(place).cameras["front"]
    assert (camera.model, len(camera.distortion), camera.K[0, 0]) == (model, num, fx)
    expected = T_CAM_LIDAR.copy()
    if kind == "rectified":
        expected[:3] = R @ expected[:3]
    np.testing.assert_allclose(camera.T_cam_lidar, expected, atol=1e-12)


def test_binned_parts_of_a_sensor(tmp_path):
    """A pixel of the image is 2 x 2 of the sensor, from (10, 4) on."""
    info = {"size": (100, 100), "binning": (2, 2), "roi": (10, 4, 12, 16), "d": [0.0] * 5}
    camera = open_sequence(with_camera(info=info).write(tmp_path)).cameras["front"]
    assert (camera.width_px, camera.height_px) == (8, 6)
    # the sensor's pixel 3.5 is -6.5 of the part: its binned pixel's centre is at (-6.5 - 0.5) / 2
    np.testing.assert_allclose(camera.K[:2], [[50, 0, -3.5], [0, 55, -1.0]])


def test_compressed_images_and_the_best_of_several(tmp_path):
    maker = with_camera()
    data = cv2.imencode(".png", PIXELS[:, :, ::-1])[1].ravel()
    type_ = "sensor_msgs/msg/CompressedImage"
    header = maker.header(STAMP_NS + 5, "front_optical")
    message = maker.make(type_, header, "png", data)
    maker.put("/front/image_rect_color/compressed", type_, message, STAMP_NS + 6)
    maker.put("/depth/image_raw/compressed", type_, message, STAMP_NS + 6)
    maker.put("/rear/image_raw/compressed", type_, message, STAMP_NS + 6)
    place = maker.write(tmp_path)
    sequence = open_sequence(place)
    assert set(sequence.cameras) == {"front"}
    assert sequence.cameras["front"].K[0, 0] == 90  # P
    np.testing.assert_array_equal(sequence.image("front", 0), PIXELS)
    assert (
        "/rear/image_raw/compressed: no /rear/camera_info" in dict(sequence.findings())["no camera"]
    )
    named = open_sequence(f"ros:{place}#images=/front/image_raw")
    assert named.cameras["front"].K[0, 0] == 100
    assert not open_sequence(f"ros:{place}#images=none").cameras


# Poses

T_BASE_LIDAR = pose(90, 1.0, 0.2, 1.7)


def driven(T_at):
    """Poses every 50 ms around two sweeps."""
    maker = Maker()
    maker.sweeps(2)
    maker.transform("base", "lidar", T_BASE_LIDAR)
    for i in range(-2, 6):
        T_at(maker, i, STAMP_NS + 25_000_000 + i * 50_000_000)
    return maker


def at(i):
    return pose(2.0 * i, 0.5 * i, 0.1, 0.0)


def test_odometry_is_brought_to_the_lidar(tmp_path):
    maker = driven(lambda m, i, ns: m.odometry(at(i), ns))
    sequence = open_sequence(maker.write(tmp_path))
    between = pose(2.0 * -0.5, 0.5 * -0.5, 0.1, 0.0)  # the stamp lies halfway between two poses
    np.testing.assert_allclose(sequence.T_world_lidar(0), between @ T_BASE_LIDAR, atol=1e-3)
    assert "/odom, 8 of them" in dict(sequence.findings())["poses from"]
    place = maker.write(tmp_path / "again")
    with pytest.raises(InputError, match="no poses"):
        open_sequence(f"ros:{place}#poses=none").T_world_lidar(0)


def test_registered_clouds_are_taken_back_out_of_the_world_of_their_odometry(tmp_path):
    maker, columns = Maker(), scan()
    points = np.column_stack([columns[axis] for axis in "xyz"])
    T = pose(30.0, 4.0, -2.0, 0.5)
    placed = (points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    for i in range(3):
        maker.cloud(dict(zip("xyz", placed.T, strict=True)), STAMP_NS + i * PERIOD_NS, frame="odom")
        maker.odometry(T, STAMP_NS + i * PERIOD_NS, child="body")
    sequence = open_sequence(maker.write(tmp_path))
    np.testing.assert_allclose(sequence[1].points, points, atol=1e-4)
    np.testing.assert_allclose(sequence.T_world_lidar(1), T, atol=1e-9)
    assert "out of the world of /odom" in dict(sequence.findings())["lidar"]


def test_transforms_are_poses_and_the_smooth_frame_is_the_world(tmp_path):
    def both(maker, i, stamp_ns):
        maker.transform("odom", "base", at(i), "/tf", stamp_ns)
        maker.transform("map", "odom", pose(0, 5.0 * (i > 2), 0, 0), "/tf", stamp_ns)
        maker.transform("base", "mast", pose(0, 0, 0, 2.0), "/tf", stamp_ns)  # published, but fixed

    sequence = open_sequence(driven(both).write(tmp_path))
    between = pose(-1.0, -0.25, 0.1, 0.0)
    np.testing.assert_allclose(sequence.T_world_lidar(0), between @ T_BASE_LIDAR, atol=1e-3)
    assert dict(sequence.findings())["poses from"] == "/tf, odom to lidar"
    np.testing.assert_allclose(
        sequence._transforms.between("mast", "lidar"), pose(0, 0, 0, -2.0) @ T_BASE_LIDAR, atol=1e-9
    )


# Damage


def bad_cloud(**changes):
    def make():
        maker = Maker()
        maker.sweeps(2)
        message = maker.written[1][3]
        for name, value in changes.items():
            object.__setattr__(message, name, value)
        return maker

    return make


RAW = "#images=/front/image_raw"
BAGS = {
    "unknown option": (bad_cloud(), "#topic=/a", r"got topic, expected #points="),
    "unknown topic": (bad_cloud(), "#points=/other", r"no such topic; topics that fit: /points"),
    "cut data": (bad_cloud(data=np.zeros(99, np.uint8)), "", "got 99 bytes and rows of"),
    "encoding": (lambda: with_camera("32FC1"), RAW, "got the encoding 32FC1, expected one of rgb8"),
    "lens": (
        lambda: with_camera(info={"model": "ftheta", "d": [1.0]}),
        RAW,
        "distortion model 'ftheta', expected one of plumb_bob",
    ),
}


@pytest.mark.parametrize("damage", BAGS)
def test_bad_bags_are_refused_in_a_line(damage, tmp_path):
    make, options, says = BAGS[damage]
    place = make().write(tmp_path)
    check_refused(f"ros:{place}{options}", says, place, frame=1)


def test_a_camera_that_cannot_be_placed_is_left_out_with_a_word(tmp_path):
    maker = with_camera()
    maker.written = [w for w in maker.written if w[1] != "/tf_static"]
    place = maker.write(tmp_path)
    sequence = open_sequence(place)
    assert not sequence.cameras
    assert "joins the camera's frame front_optical" in dict(sequence.findings())["no camera"]
    with pytest.raises(InputError, match="joins the camera's frame front_optical"):
        open_sequence(f"ros:{place}#images=/front/image_raw")


def test_encodings_that_cannot_be_read_are_named_by_info(tmp_path, capsys):
    place = with_camera("bayer_rggb16").write(tmp_path)
    assert exit_code("info", place) == 0
    assert "got the encoding bayer_rggb16, expected one of rgb8" in capsys.readouterr().out
    (tmp_path / "video").mkdir()
    maker = Maker()
    maker.sweeps(2)
    maker.compressed(b"\x00\x00\x00\x01video", topic="/front/image_raw/compressed")
    maker.info()
    maker.transform("lidar", "front_optical", inverse(T_CAM_LIDAR))
    sequence = open_sequence(maker.write(tmp_path / "video"))
    assert "expected JPEG or PNG" in dict(sequence.findings())["no camera"]


def test_messages_recorded_twice_are_read_once_and_late_ones_in_order(tmp_path):
    maker = Maker()
    for i in (0, 1, 3, 2, 2, 4):
        maker.cloud(scan(60 + i), STAMP_NS + i * PERIOD_NS)
    sequence = open_sequence(maker.write(tmp_path))
    assert [sequence.stamp_ns(f) for f in sequence.frames] == [
        STAMP_NS + i * PERIOD_NS for i in range(5)
    ]
    assert [len(sequence[f]) for f in sequence.frames] == [60, 61, 62, 63, 64]
    assert sequence.gaps() == ["/points: 1 messages were recorded twice and are read once"]


def test_an_only_row_needs_no_step(tmp_path):
    sequence = open_sequence(bad_cloud(row_step=0)().write(tmp_path))
    np.testing.assert_array_equal(sequence[1].points[:, 0].astype("f4"), scan()["x"])


@pytest.mark.parametrize("suffix", [".db3", ".mcap"])
def test_files_compressed_as_a_whole(suffix, tmp_path):
    """The folder is read by its metadata; a file alone cannot be."""
    maker = Maker(suffix)
    maker.sweeps(2)
    place = maker.write(tmp_path, compressed=True)
    (file,) = place.glob("*.zstd")
    sequence = open_sequence(place)
    np.testing.assert_array_equal(sequence[1].points[:, 0].astype("f4"), scan()["x"])
    with pytest.raises(InputError, match=rf"decompress it by zstd -d {file.name} and name"):
        open_sequence(file)
    (place / "metadata.yaml").unlink()
    with pytest.raises(InputError, match="name the bag's folder with its metadata"):
        open_sequence(place)


@pytest.mark.parametrize(("profile", "says"), [("", "of other programs"), ("px4", "of px4")])
def test_an_mcap_of_other_messages_is_not_called_broken(profile, says, tmp_path):
    mcap_writer = pytest.importorskip("mcap.writer")
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = mcap_writer.Writer(file)
        writer.start(profile, "test")
        schema = writer.register_schema("thing", "jsonschema", b"{}")
        channel = writer.register_channel("/thing", "json", schema)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(InputError, match=f"is a whole MCAP file with messages {says}") as error:
        open_sequence(tmp_path / "a.mcap")
    assert "mended" not in str(error.value)


@pytest.mark.parametrize("share", [0.0, 0.5])
@pytest.mark.parametrize("suffix", [".db3", ".mcap", ".bag"])
def test_cut_off_bags_are_refused_in_a_line(suffix, share, tmp_path):
    maker = Maker(suffix)
    maker.sweeps(40)
    place = maker.write(tmp_path)
    file = place if place.is_file() else next(place.glob(f"*{suffix}"))
    data = file.read_bytes()
    file.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError) as error:
        sequence = open_sequence(f"ros:{place}")
        for frame in range(40):
            sequence[frame]
    message = str(error.value)
    assert message.startswith(f"{place}: ") and "\n" not in message


def test_stamps_that_drivers_leave_at_zero_are_those_of_the_recording(tmp_path):
    maker = Maker()
    for i in range(2):
        maker.cloud(scan(), 0)
        maker.written[-1] = (STAMP_NS + i * PERIOD_NS, *maker.written[-1][1:])
    sequence = open_sequence(maker.write(tmp_path))
    assert [sequence.stamp_ns(f) for f in (0, 1)] == [STAMP_NS, STAMP_NS + PERIOD_NS]
