# SPDX-License-Identifier: MIT
"""Argoverse 2, DGP, nuScenes and PandaSet: streets written in their formats, and real recordings.

Pickles that want to run something are refused.
"""

from __future__ import annotations

import gzip
import json
import pickle
import tracemalloc

import numpy as np
import pytest
from writers import write_street
from writers.argoverse2 import T_EGO_LIDAR
from writers.excerpt import Excerpt
from writers.nuscenes import T_LIDAR_POINTS, last_column_ns

from densify.config.errors import InputError
from densify.free_space.sensor import find_rings
from densify.geometry.poses import inverse, transform
from densify.readers import open_sequence
from densify.readers.argoverse2 import Argoverse2
from densify.readers.decoded_files import read_pickled
from densify.readers.nuscenes import find_records
from densify.readers.pandaset import T_POSE_LIDAR, PandaSet
from densify.readers.street import Street
from tests.reader_checks import check_cameras, check_image_poses, check_sweeps, check_truth
from tests.recorded import excerpt_of

HALF_NS = 50_000_000
AV2_LOG = "argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def median_spread_deg(points: np.ndarray, ring: np.ndarray, least_m: float) -> float:
    """Return the median over the rings of how far elevations are from that of their ring."""
    x, y, z = points.T
    elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
    far = np.hypot(x, y) > least_m
    rings = [elevation_deg[far & (ring == number)] for number in range(32)]
    return np.median([np.median(np.abs(r - np.median(r))) for r in rings if len(r) > 50])


@pytest.mark.parametrize(
    ("format", "up", "name", "spec_of_no_recording", "says"),
    [
        ("argoverse2", 1, "street", "street/sensors", "no Argoverse 2 log"),
        ("argoverse2", 2, "street", "", ""),
        ("dgp", 1, "scene_01", "scene_01/rgb", "no DGP scene"),
        ("nuscenes", 0, "scene-0001", "samples", "no nuScenes tables"),
    ],
)
def test_scenes_are_named(recorded, format, up, name, spec_of_no_recording, says):
    place = [recorded(format), *recorded(format).parents][up]
    assert open_sequence(place).name == name  # the only one
    assert open_sequence(f"{format}:{place}#{name}").name == name
    with pytest.raises(InputError, match=rf"no recording other; choose one.*one of {name}$"):
        open_sequence(f"{format}:{place}#other")
    if says:
        with pytest.raises(InputError, match=says):
            open_sequence(f"{format}:{place / spec_of_no_recording}")


# Argoverse 2


def test_argoverse2_street(recorded):
    sequence, excerpt = open_sequence(recorded("argoverse2")), excerpt_of("argoverse2")
    # half a step of float16 beyond 64 m, in three directions
    check_sweeps(sequence, excerpt, -HALF_NS, inverse(T_EGO_LIDAR), point_m=0.06)
    check_cameras(sequence, excerpt, inverse(T_EGO_LIDAR), same_pixels=False)
    check_image_poses(sequence, excerpt, atol=1e-4)
    check_truth(sequence, excerpt)


def test_two_scanners_of_argoverse2_keep_their_places(tmp_path):
    street = Street("static", 0, "dual32", cameras=())
    sweep = Argoverse2(write_street("argoverse2", street, tmp_path, [60]))[0]
    np.testing.assert_array_equal(sweep.lidar, street[60].lidar)
    np.testing.assert_allclose(sweep.scanner_origins, street[60].scanner_origins + [1.35, 0, 1.64])


def test_a_real_argoverse2_log(test_data):
    sequence = open_sequence(test_data / AV2_LOG)
    assert list(sequence.frames) == [0, 1] and not sequence.cameras
    sweep = sequence[0]
    assert len(sweep) == 99_229 and sweep.stamp_ns == 315_966_265_259_836_000
    assert (sweep.offset_ns.min(), sweep.offset_ns.max()) == (2_654_000, 106_085_816)
    origins_m = [[1.35018, 0, 1.64042], [1.34676, 0.00457, 1.52550]]
    np.testing.assert_allclose(sweep.scanner_origins, origins_m, atol=1e-5)
    assert 0.4 < sweep.intensity.max() <= 1 and set(sweep.lidar) == {0, 1}
    # The file's first row was fired 2.7 ms after the stamp: at 0.6 m/s the vehicle was 1.6 mm
    # farther ahead by then, and the point as much nearer.
    step_m = np.linalg.norm((inverse(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(1))[:3, 3])
    moved_m = step_m / 0.100196 * sweep.offset_ns[0] * 1e-9
    away_m = np.linalg.norm(sweep.points[0] - [-1.537109375, 3.060546875, -0.322509765625])
    assert away_m == pytest.approx(moved_m, rel=0.5)


def test_real_rings_of_argoverse2_are_sharp_as_fired(test_data):
    feather = pytest.importorskip("pyarrow.feather")
    sequence = open_sequence(test_data / AV2_LOG)
    sweep = sequence[0]
    table = feather.read_table(min((test_data / AV2_LOG / "sensors/lidar").iterdir()))
    laser = table["laser_number"].to_numpy()
    stored = np.stack([table[axis].to_numpy().astype(float) for axis in "xyz"], axis=1)
    back = sequence._track.compensate(sweep.points, sweep.stamp_ns, sweep.offset_ns)
    np.testing.assert_allclose(back, stored, atol=1e-9)
    T_scanner_ego = inverse(sequence._T_ego_sensor["up_lidar"])
    assert median_spread_deg(transform(T_scanner_ego, stored), laser, 10) > 0.03
    assert median_spread_deg(transform(T_scanner_ego, sweep.points), laser, 10) < 0.003


# DGP


def test_dgp_street(recorded):
    sequence, excerpt = open_sequence(recorded("dgp")), excerpt_of("dgp")
    street = excerpt.street
    assert list(sequence.frames) == [0, 1, 2]
    check_cameras(sequence, excerpt)
    check_image_poses(sequence, excerpt, atol=1e-9)
    check_truth(sequence, excerpt)
    for number, frame in enumerate(excerpt.frames):
        sweep, true = sequence[number], street.truth.sweep(frame)
        assert sweep.stamp_ns == sequence.stamp_ns(number) == street.stamp_ns(frame)
        assert sweep.offset_ns is None and sweep.scanner_origins is None
        still = ~true.moving
        np.testing.assert_allclose(sweep.points[still], true.points[still], atol=1e-4)
        np.testing.assert_array_equal(sweep.intensity, street[frame].intensity)
        T_world_lidar = street.T_world_lidar(frame)
        np.testing.assert_allclose(sequence.T_world_lidar(number), T_world_lidar, atol=1e-9)


def test_a_real_dgp_scene(test_data):
    sequence = open_sequence(test_data / "ddad")
    assert list(sequence.frames) == [0, 1, 2]
    assert list(sequence.cameras) == [f"CAMERA_0{n}" for n in (1, 5, 6, 7, 8, 9)]
    # names of files are tenths of microseconds
    assert sequence.stamp_ns(0) == 1_561_645_825_002_790_000
    assert sequence.image_stamps_ns("CAMERA_05")[2] == 1_561_645_825_193_647_200
    front = sequence.cameras["CAMERA_01"]
    assert (front.width_px, front.height_px, front.K[0, 0]) == (1936, 1216, 2181.530254382263)
    T_ego_cam = inverse(front.T_cam_lidar)
    np.testing.assert_allclose(T_ego_cam[:3, 3], [1.48554, 0.28616, 1.56173], atol=1e-5)
    np.testing.assert_allclose(T_ego_cam[:3, 2], [1, 0, 0], atol=0.1)  # looks ahead
    sweep = sequence[0]
    path = test_data / "ddad/scene_02/point_cloud/LIDAR/15616458250027900.npz"
    stored = np.load(path)["data"]
    assert len(sweep) == len(stored) == 47_230
    np.testing.assert_array_equal(sweep.points, stored[:, :3])
    np.testing.assert_allclose(sweep.intensity, stored[:, 3], atol=1e-7)
    # the mean of the six places in the calibration
    np.testing.assert_allclose(sweep.scanner_origins, [[1.14779, 0.07166, 1.55299]], atol=1e-5)
    poses = [sequence.T_world_lidar(n)[:3, 3] for n in range(3)]
    np.testing.assert_allclose(poses[0], [111.45486, -2261.38424, -12.73396], atol=1e-5)
    steps_m = np.linalg.norm(np.diff(poses, axis=0), axis=1)
    np.testing.assert_allclose(steps_m, 1.26, atol=0.03)
    # an image's pose is where the vehicle, 12.7 m/s fast, was 2 to 3 ms before the sweep's stamp
    for name, camera in sequence.cameras.items():
        T_lidar_world, T_lidar_cam = inverse(sequence.T_world_lidar(1)), inverse(camera.T_cam_lidar)
        at_image = T_lidar_world @ sequence.T_world_cam(name, 1)
        np.testing.assert_allclose(T_lidar_cam[1:3, 3], at_image[1:3, 3], atol=0.001)
        assert 0.002 < (T_lidar_cam - at_image)[0, 3] / 12.7 < 0.003


# nuScenes


def file_order(excerpt, frame):
    """Which of the street's returns each row of the file is: by columns, from the lowest ring."""
    returns = excerpt.returns(frame)
    fired_ns = np.arange(1084 * 32) * 50_000_000 // (1084 * 32) - 25_000_000
    column = np.searchsorted(fired_ns, returns.offset_ns) // 32
    return np.lexsort((excerpt.rings(frame), column))


def test_nuscenes_street(recorded):
    sequence, excerpt = open_sequence(recorded("nuscenes")), excerpt_of("nuscenes")
    assert open_sequence(recorded("nuscenes") / "v1.0-mini").name == "scene-0001"
    first = excerpt.frames[0]
    late_ns = last_column_ns(excerpt, first) - excerpt.street.stamp_ns(first)
    for number, frame in enumerate(excerpt.frames):  # all in the file's order
        order = file_order(excerpt, frame)
        read, true = sequence[number], excerpt.street[frame]
        points = true.points[order] @ T_LIDAR_POINTS[:3, :3]
        np.testing.assert_allclose(read.points, points, atol=0.003)
        # 46.08 us a column instead of 50 ms / 1084, and one time for a column
        offset_ns = true.offset_ns[order]
        np.testing.assert_allclose(read.offset_ns + late_ns, offset_ns, atol=46_130 + 1084 * 46)
        np.testing.assert_allclose(read.intensity, true.intensity[order], atol=1 / 255)
    check_cameras(sequence, excerpt, T_LIDAR_POINTS, stamp_ns=1000, same_pixels=False)
    check_image_poses(sequence, excerpt, atol=1e-6)
    check_truth(sequence, excerpt)
    steps = [
        inverse(s.T_world_lidar(a)) @ s.T_world_lidar(b)
        for s, a, b in ((sequence, 0, 2), (excerpt.street, excerpt.frames[0], excerpt.frames[2]))
    ]
    assert abs(np.linalg.norm(steps[0][:3, 3]) - np.linalg.norm(steps[1][:3, 3])) < 0.01


def test_of_millions_of_records_few_are_parsed(tmp_path):
    record = '{"token": "%d", "sample_token": "s%d", "filename": "x"}'
    lines = ",\n".join(record % (i, i // 10) for i in range(50_000))
    (tmp_path / "sample_data.json").write_text(f"[\n{lines}\n]\n")
    tracemalloc.start()
    found = find_records(tmp_path / "sample_data.json", "sample_token", {"s7", "s4999"})
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert list(found) == [str(i) for i in (*range(70, 80), *range(49_990, 50_000))]
    assert peak < 1_000_000


def test_a_real_key_frame_of_nuscenes(test_data):
    sequence = open_sequence(test_data / "nuscenes")
    assert sequence.name == "scene-0061" and list(sequence.frames) == [0]
    assert len(sequence.cameras) == 6 and next(iter(sequence.cameras)) == "CAM_FRONT"
    sweep = sequence[0]
    assert sweep.stamp_ns == 1_532_402_927_647_951_000
    assert sweep.row[-1] == 34_687 and len(sweep) == 34_688 - 4_393  # without a return
    assert (sweep.offset_ns.min(), sweep.offset_ns.max()) == (-1083 * 46_080, 0)
    range_m = np.linalg.norm(sweep.points, axis=1)
    assert range_m.min() > 0.2 and 3700 < (range_m < 1).sum() < 3800  # the roof
    assert sequence.image_stamps_ns("CAM_FRONT")[0] == 1_532_402_927_612_460_000
    assert sequence.image("CAM_FRONT", 0).shape == (900, 1600, 3)
    # the scanner stands 0.94 m ahead of and 1.84 m above the rear axle, and looks to the right
    T_world_ego = sequence._ego.T_world_ego[-1]
    T_ego_lidar = inverse(T_world_ego) @ sequence.T_world_lidar(0)
    np.testing.assert_allclose(T_ego_lidar[:3, 3], [0.943713, 0, 1.84023], atol=1e-6)
    assert T_ego_lidar[0, 1] > 0.999
    # exposed 35.5 ms before the stamp, at 9.25 m/s
    T_ego_cam = inverse(T_world_ego) @ sequence.T_world_cam("CAM_FRONT", 0)
    assert T_ego_cam[0, 3] - 1.70079 == pytest.approx(-0.0355 * 9.25, abs=0.02)
    path = next((test_data / "nuscenes/samples/LIDAR_TOP").iterdir())
    rows = np.fromfile(path, "<f4").reshape(-1, 5)[sweep.row]
    assert median_spread_deg(rows[:, :3], rows[:, 4], 5) > 0.03
    assert median_spread_deg(sweep.points, rows[:, 4], 5) < 0.002


# PandaSet


def test_pandaset_street(recorded):
    sequence, excerpt = open_sequence(recorded("pandaset")), excerpt_of("pandaset")
    # seconds as float64 are good to 0.5 µs, in which the vehicle goes 7 µm
    check_sweeps(sequence, excerpt, HALF_NS, point_m=1e-5, offset_ns=500)
    check_cameras(sequence, excerpt, same_pixels=False, place_m=0.005)  # turns between poses
    check_image_poses(sequence, excerpt, atol=1e-9)
    check_truth(sequence, excerpt)


def test_points_of_both_scanners_of_pandaset(tmp_path):
    """Those of the real vehicle stand where the street's do."""
    street = Street("static", 0, "dual32", cameras=())
    sequence = PandaSet(write_street("pandaset", street, tmp_path, [60, 61]))
    check_sweeps(sequence, Excerpt.of(street, [60, 61], []), HALF_NS, point_m=1e-5, offset_ns=500)
    sensor = Street("static", 0, "pandaset", cameras=()).simulator.sensor
    np.testing.assert_array_equal(sequence[0].scanner_origins, sensor.origins_m)


class Runs:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_a_pickle_runs_nothing(tmp_path):
    trace, path = tmp_path / "trace", tmp_path / "00.pkl.gz"
    evil = (
        pickle.dumps(Runs(trace)),
        f"cos\nsystem\n(S'touch {trace}'\ntR.".encode(),
        f"cbuiltins\nexec\n(Vopen({str(trace)!r}, 'w')\ntR.".encode(),
        f"(S'touch {trace}'\nios\nsystem\n.".encode(),  # the old INST opcode
        # by a name inside one that is allowed
        f"\x80\x04\x8c\x06pandas\x8c\x17core.frame.os.system\x93(V{trace}\ntR.".encode("latin-1"),
        b"\x80\x04\x8c\x0epandas.core.frame\x8c\x09DataFrame\x93\x82\x01.",  # an extension code
        b"cpandas.core.frame\nDataFrame\n)\x81}(X\x05\0\0\0_datacos\nsystem\nub.",  # inside one
        b"cpandas.core.frame\nDataFrame\n}X\x05\0\0\0__new__cbuiltins\nslice\nsb.",
    )
    for data in evil:
        path.write_bytes(gzip.compress(data))
        with pytest.raises(InputError, match="nothing in it was run") as error:
            read_pickled(path)
        assert "\n" not in str(error.value)
    assert not trace.exists()


def test_a_real_pandaset_sequence(test_data):
    path = test_data / "pandaset/002"
    sequence = open_sequence(path)
    assert list(sequence.frames) == list(range(10, 25))
    assert list(sequence.image_stamps_ns("left_camera")) == list(range(9, 26))
    assert sequence.stamp_ns(10) == 1_557_539_957_500_393_000
    assert sequence.image_stamps_ns("front_camera")[10] == 1_557_539_957_450_529_000
    assert next(iter(sequence.cameras)) == "front_camera"
    front = sequence.cameras["front_camera"]
    assert (front.width_px, front.height_px, front.K[0, 0]) == (1920, 1080, 1970.0131)
    # it hangs 9 cm before the scanner and 5 cm below it, and looks ahead
    np.testing.assert_allclose(inverse(front.T_cam_lidar)[:3, 3], [0.08, 0, -0.05], atol=0.02)
    np.testing.assert_allclose(inverse(front.T_cam_lidar)[:3, 2], [1, 0, 0], atol=0.03)
    sweep, columns = sequence[24], read_pickled(path / "lidar/24.pkl.gz")
    assert len(sweep) == 167_214 and np.bincount(sweep.lidar).tolist() == [106_021, 61_193]
    np.testing.assert_allclose(sweep.intensity * 255, columns["i"], atol=1e-4)
    since_s = columns["t"] - 1557539958.900671
    np.testing.assert_allclose(sweep.offset_ns, since_s * 1e9, atol=500)
    # at the end of the sweep the points are where the file has them: the poses are those of the
    # file, the vehicle does not turn, and at 0.35 m/s it goes 3.5 mm in a hundredth of a second
    late = np.abs(sweep.offset_ns) < 10_000_000
    world = transform(sequence.T_world_lidar(24), sweep.points)
    stored = np.stack([columns[axis] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(world[late], stored[late], atol=0.0045)
    assert 0.01 < np.linalg.norm(world - stored, axis=1).max() < 0.06
    pose = json.loads((path / "lidar/poses.json").read_text())[24]["position"]
    T_world_pose = sequence.T_world_lidar(24) @ inverse(T_POSE_LIDAR)
    np.testing.assert_allclose(T_world_pose[:3, 3], [pose[axis] for axis in "xyz"], atol=1e-9)


def test_real_rings_of_pandaset_are_sharp_from_where_the_scanner_stands(test_data):
    sweep = open_sequence(test_data / "pandaset/002")[10]
    turning = sweep.points[sweep.lidar == 0]
    x, y, z = turning[np.linalg.norm(turning, axis=1) > 4].T
    elevation = np.arctan2(z, np.hypot(x, y)).astype(np.float32)
    rings_deg = np.degrees(find_rings(elevation))
    assert len(rings_deg) == 64
    # as the maker states: a sixth of a degree apart in the middle, 6 degrees at the lower end
    assert rings_deg[1] - rings_deg[0] == pytest.approx(6, abs=0.2)
    middle_deg = rings_deg[(rings_deg > -5) & (rings_deg < 1.9)]
    np.testing.assert_allclose(np.diff(middle_deg), 1 / 6, atol=0.03)
    moved = np.arctan2(z + 0.05, np.hypot(x + 0.05, y)).astype(np.float32)
    assert find_rings(moved) is None or len(find_rings(moved)) < 64
