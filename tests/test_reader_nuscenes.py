# SPDX-License-Identifier: MIT
"""The nuScenes reader on a street written as a tree and on a real key frame."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from writers.nuscenes import T_LIDAR_POINTS, last_column_ns

from densify.config.errors import InputError
from densify.geometry.poses import inverse
from densify.readers import open_sequence
from densify.readers.nuscenes import NuScenes, find_records
from tests.reader_checks import check_cameras, check_truth
from tests.recorded import CAMERA

FORMAT = "nuscenes"
VERSION = "v1.0-mini"


def file_order(excerpt, frame):
    """Which of the street's returns each row of the file is: by columns, from the lowest ring."""
    returns = excerpt.returns(frame)
    fired_ns = np.arange(1084 * 32) * 50_000_000 // (1084 * 32) - 25_000_000
    column = np.searchsorted(fired_ns, returns.offset_ns) // 32
    return np.lexsort((excerpt.rings(frame), column))


def test_the_street_is_given_back(written, excerpt):
    sequence = open_sequence(written)
    assert isinstance(sequence, NuScenes) and sequence.name == "scene-0001"
    first = excerpt.frames[0]
    late_ns = last_column_ns(excerpt, first) - excerpt.street.stamp_ns(first)
    for number, frame in enumerate(excerpt.frames):  # all in the file's order
        order = file_order(excerpt, frame)
        read, true = sequence[number], excerpt.street[frame]
        points = true.points[order] @ T_LIDAR_POINTS[:3, :3]
        np.testing.assert_allclose(read.points, points, atol=0.003)
        # 46.08 us a column instead of 50 ms / 1084, and one time for a column
        np.testing.assert_allclose(
            read.offset_ns + late_ns, true.offset_ns[order], atol=46_130 + 1084 * 46
        )
        np.testing.assert_allclose(read.intensity, true.intensity[order], atol=1 / 255)
    check_cameras(sequence, excerpt, T_LIDAR_POINTS, stamp_ns=1000, same_pixels=False)
    check_truth(sequence, excerpt)
    steps = [
        inverse(s.T_world_lidar(a)) @ s.T_world_lidar(b)
        for s, a, b in ((sequence, 0, 2), (excerpt.street, excerpt.frames[0], excerpt.frames[2]))
    ]
    assert abs(np.linalg.norm(steps[0][:3, 3]) - np.linalg.norm(steps[1][:3, 3])) < 0.01


def test_a_pose_for_each_image(written, excerpt):
    sequence = open_sequence(written)
    exposed_ns = excerpt.street.image_stamps_ns(CAMERA)
    for number, image in enumerate(excerpt.image_numbers(CAMERA)):
        T_world_lidar = excerpt.street.simulator.T_world_lidar_at(exposed_ns[image])
        expected = T_world_lidar @ inverse(excerpt.street.cameras[CAMERA].T_cam_lidar)
        np.testing.assert_allclose(sequence.T_world_cam(CAMERA, number), expected, atol=1e-6)


def test_scenes_are_named(written):
    assert open_sequence(f"nuscenes:{written}#scene-0001").name == "scene-0001"
    assert open_sequence(written / VERSION).name == "scene-0001"
    with pytest.raises(InputError, match=r"no recording scene-0002; .* one of scene-0001"):
        open_sequence(f"nuscenes:{written}#scene-0002")


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


# A real key frame


def test_a_real_key_frame(test_data):
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


def test_real_rings_are_sharp_as_fired(test_data):
    sweep = open_sequence(test_data / "nuscenes")[0]
    path = next((test_data / "nuscenes/samples/LIDAR_TOP").iterdir())
    rows = np.fromfile(path, "<f4").reshape(-1, 5)[sweep.row]

    def spread_deg(points):
        x, y, z = points.T
        elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
        rings = [elevation_deg[(rows[:, 4] == r) & (np.hypot(x, y) > 5)] for r in range(32)]
        return np.median([np.median(np.abs(r - np.median(r))) for r in rings if len(r) > 50])

    assert spread_deg(rows[:, :3]) > 0.03
    assert spread_deg(sweep.points) < 0.002
