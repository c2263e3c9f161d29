# SPDX-License-Identifier: MIT
"""The PandaSet reader on a street written as a sequence, on pickles that want to
run something, and on a real sequence."""

from __future__ import annotations

import gzip
import json
import pickle

import numpy as np
import pytest
from writers import write_street
from writers.excerpt import Excerpt

from densify.config.errors import InputError
from densify.free_space.sensor import find_rings
from densify.geometry.poses import inverse, transform
from densify.readers import open_sequence
from densify.readers.column_files import read_pickled
from densify.readers.pandaset import T_POSE_LIDAR, PandaSet
from densify.readers.street import Street
from tests.reader_checks import check_cameras, check_sweeps, check_truth
from tests.recorded import CAMERA

FORMAT = "pandaset"
HALF_NS = 50_000_000


def test_the_street_is_given_back(written, excerpt):
    sequence = open_sequence(written)
    assert isinstance(sequence, PandaSet)
    # seconds as float64 are good to 0.5 µs, in which the vehicle goes 7 µm
    check_sweeps(sequence, excerpt, HALF_NS, point_m=1e-5, offset_ns=500)
    check_cameras(sequence, excerpt, same_pixels=False, place_m=0.005)  # turns between poses
    check_truth(sequence, excerpt)
    T_lidar_cam = inverse(excerpt.street.cameras[CAMERA].T_cam_lidar)
    exposed_ns = sequence.image_stamps_ns(CAMERA)[1]
    expected = excerpt.street.simulator.T_world_lidar_at(exposed_ns) @ T_lidar_cam
    np.testing.assert_allclose(sequence.T_world_cam(CAMERA, 1), expected, atol=1e-9)


def test_points_of_both_scanners(tmp_path):
    """Those of the real vehicle stand where the street's do."""
    street = Street("static", 0, "dual32", cameras=())
    sequence = PandaSet(write_street("pandaset", street, tmp_path, [60, 61]))
    check_sweeps(sequence, Excerpt.of(street, [60, 61], []), HALF_NS, point_m=1e-5, offset_ns=500)
    sensor = Street("static", 0, "pandaset", cameras=()).simulator.sensor
    np.testing.assert_array_equal(sequence[0].scanner_origins, sensor.origins_m)


# Pickles that want to run something


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


# A real sequence


def test_a_real_sequence(test_data):
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


def test_real_rings_are_sharp_from_where_the_scanner_stands(test_data):
    sweep = open_sequence(test_data / "pandaset/002")[10]
    turning = sweep.points[sweep.lidar == 0]
    x, y, z = turning[np.linalg.norm(turning, axis=1) > 4].T
    elevation = np.arctan2(z, np.hypot(x, y)).astype(np.float32)
    rings_deg = np.degrees(find_rings(elevation))
    assert len(rings_deg) == 64
    # as the maker states: a sixth of a degree apart in the middle, 6 degrees at the lower end
    assert rings_deg[1] - rings_deg[0] == pytest.approx(6, abs=0.2)
    np.testing.assert_allclose(
        np.diff(rings_deg[(rings_deg > -5) & (rings_deg < 1.9)]), 1 / 6, atol=0.03
    )
    moved = np.arctan2(z + 0.05, np.hypot(x + 0.05, y)).astype(np.float32)
    assert find_rings(moved) is None or len(find_rings(moved)) < 64
