# SPDX-License-Identifier: MIT
"""The Argoverse 2 reader on a street written as a log and on a real one."""

from __future__ import annotations

import numpy as np
import pytest
from writers import write_street
from writers.argoverse2 import T_EGO_LIDAR

from densify.config.errors import InputError
from densify.geometry.poses import inverse, transform
from densify.readers import open_sequence
from densify.readers.argoverse2 import Argoverse2
from densify.readers.street import Street
from tests.reader_checks import check_cameras, check_sweeps, check_truth
from tests.recorded import CAMERA, FRAMES

feather = pytest.importorskip("pyarrow.feather")

FORMAT = "argoverse2"
HALF_NS = 50_000_000
REAL = "argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede"


def test_the_street_is_given_back(written, excerpt):
    sequence = open_sequence(written)
    assert isinstance(sequence, Argoverse2)
    # half a step of float16 beyond 64 m, in three directions
    check_sweeps(sequence, excerpt, -HALF_NS, inverse(T_EGO_LIDAR), point_m=0.06)
    check_cameras(sequence, excerpt, inverse(T_EGO_LIDAR), same_pixels=False)
    check_truth(sequence, excerpt)
    for number, frame in enumerate(FRAMES):
        T_lidar_cam = inverse(excerpt.street.cameras[CAMERA].T_cam_lidar)
        expected = excerpt.street.T_world_lidar(frame) @ T_lidar_cam
        np.testing.assert_allclose(sequence.T_world_cam(CAMERA, number), expected, atol=1e-4)


def test_two_scanners_keep_their_places(tmp_path):
    street = Street("static", 0, "dual32", cameras=())
    sweep = Argoverse2(write_street("argoverse2", street, tmp_path, [60]))[0]
    np.testing.assert_array_equal(sweep.lidar, street[60].lidar)
    np.testing.assert_allclose(sweep.scanner_origins, street[60].scanner_origins + [1.35, 0, 1.64])


def test_logs_are_scenes(written):
    for place in (written.parent, written.parent.parent):
        assert open_sequence(place).name == written.name  # the only one
        assert open_sequence(f"argoverse2:{place}#street").name == written.name
        with pytest.raises(InputError, match=r"no recording other.*one of street$"):
            open_sequence(f"argoverse2:{place}#other")
    with pytest.raises(InputError, match="no Argoverse 2 log"):
        open_sequence(f"argoverse2:{written / 'sensors'}")


# A real log


def test_a_real_log(test_data):
    sequence = open_sequence(test_data / REAL)
    assert list(sequence.frames) == [0, 1] and not sequence.cameras
    sweep = sequence[0]
    assert len(sweep) == 99_229 and sweep.stamp_ns == 315_966_265_259_836_000
    assert (sweep.offset_ns.min(), sweep.offset_ns.max()) == (2_654_000, 106_085_816)
    np.testing.assert_allclose(
        sweep.scanner_origins, [[1.35018, 0, 1.64042], [1.34676, 0.00457, 1.52550]], atol=1e-5
    )
    assert 0.4 < sweep.intensity.max() <= 1 and set(sweep.lidar) == {0, 1}
    # The file's first row was fired 2.7 ms after the stamp: at 0.6 m/s the vehicle was 1.6 mm
    # farther ahead by then, and the point as much nearer.
    step_m = np.linalg.norm((inverse(sequence.T_world_lidar(0)) @ sequence.T_world_lidar(1))[:3, 3])
    late_s = sweep.offset_ns[0] * 1e-9
    moved_m = step_m / 0.100196 * late_s
    away_m = np.linalg.norm(sweep.points[0] - [-1.537109375, 3.060546875, -0.322509765625])
    assert away_m == pytest.approx(moved_m, rel=0.5)


def test_real_rings_are_sharp_as_fired(test_data):
    sequence = open_sequence(test_data / REAL)
    sweep = sequence[0]
    path = sorted((test_data / REAL / "sensors/lidar").iterdir())[0]
    table = feather.read_table(path)
    laser = table["laser_number"].to_numpy()
    stored = np.stack([table[axis].to_numpy().astype(float) for axis in "xyz"], axis=1)
    back = sequence._track.compensate(sweep.points, sweep.stamp_ns, sweep.offset_ns)
    np.testing.assert_allclose(back, stored, atol=1e-9)
    T_scanner_ego = inverse(sequence._T_ego_sensor["up_lidar"])

    def spread_deg(points):
        x, y, z = transform(T_scanner_ego, points).T
        elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
        far = np.hypot(x, y) > 10
        rings = [elevation_deg[far & (laser == ring)] for ring in range(32)]
        return np.median([np.median(np.abs(r - np.median(r))) for r in rings if len(r)])

    assert spread_deg(stored) > 0.03
    assert spread_deg(sweep.points) < 0.003
