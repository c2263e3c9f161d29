# SPDX-License-Identifier: MIT
"""KITTI tracking labels of finished runs, read back by the reader of that data set."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from densify.geometry import poses
from densify.geometry.types import Result
from densify.outputs.export import export_run
from densify.outputs.key_outputs import write_result
from densify.pipeline.run import run_keys
from densify.readers.kitti.tracking import KittiTracking, open_recording, read_labels
from tests.exported import refused, write_street, write_views
from tests.scenes import SWEEP_S
from tests.small_street import KEY, POSES_GIVEN, one_car


@cache
def street_results() -> dict[int, Result]:
    """Two neighbouring keys of the street with a car."""
    made = dict(run_keys(one_car(), [KEY - 1, KEY], 1, config=POSES_GIVEN))
    assert all(isinstance(result, Result) for result in made.values())
    return made  # type: ignore[return-value]


def write_set(out: Path, **sizes_m: float) -> Path:
    """The folder of both keys; ``k3=2.0`` cuts the car of key 3 to 2 m, its front not seen."""
    for key, result in street_results().items():
        tracks = []
        for track in result.tracks:
            length_m = sizes_m.get(f"k{key}", track.size_m[0])
            behind_m = (length_m - track.size_m[0]) / 2
            T = track.T_key_object @ poses.exp(np.array([0, 0, 0, behind_m, 0, 0]))
            seen = track.sides_seen if f"k{key}" not in sizes_m else ("rear", "left", "right")
            size_m = np.array([length_m, *track.size_m[1:]])
            tracks.append(replace(track, size_m=size_m, T_key_object=T, sides_seen=seen))
        write_result(replace(result, tracks=tuple(tracks)), out, config={}, data="tiny street")
    return out


def exported(folder: Path) -> KittiTracking:
    export_run(folder, "kitti-tracking")
    return open_recording(folder / "export" / "kitti-tracking", "0000")


def test_the_reader_reads_boxes_sweep_image_and_camera(tmp_path: Path) -> None:
    result = street_results()[KEY]
    write_result(result, tmp_path, config={}, data="tiny street")
    recording = exported(tmp_path / f"{KEY:06d}")
    assert recording.frames == (KEY,) and [*recording.cameras] == ["image_02"]
    (track,), boxes = result.tracks, recording.boxes(KEY)
    assert boxes is not None and len(boxes.track) == 1
    np.testing.assert_allclose(boxes.size_m, track.size_m[None], atol=1e-5)
    # The box is where the sweep measured the car, and so are the points in it.
    T = boxes.T_lidar_box[0]
    at_reference = track.T_key_object[track.frames.index(KEY)]
    late_m = T[:3, 3] - at_reference[:3, 3]
    assert abs(late_m[0]) <= 8 * SWEEP_S / 2 + 0.05 and np.abs(late_m[1:]).max() < 0.05
    np.testing.assert_allclose(T[:2, 0], at_reference[:2, 0], atol=0.02)
    cloud = result.cloud
    mine = (cloud.frame == KEY) & (cloud.instance == track.instance)
    inside = poses.transform(poses.inverse(T), cloud.rigid_points[mine])
    assert (np.abs(inside) <= track.size_m / 2 + 0.05).mean() > 0.95
    assert len(recording[KEY]) == (cloud.frame == KEY).sum()
    camera, name = recording.cameras["image_02"], next(iter(result.views))
    np.testing.assert_allclose(camera.K, result.views[name].camera.K, rtol=1e-9)
    T_cam_lidar = result.views[name].camera.T_cam_lidar
    np.testing.assert_allclose(camera.T_cam_lidar, T_cam_lidar, atol=1e-9)


def test_the_line_of_an_object(tmp_path: Path) -> None:
    run = write_street(tmp_path)
    export_run(run, "kitti-tracking")
    path = run / "export" / "kitti-tracking" / "label_02" / "0000.txt"
    (words,) = [line.split() for line in path.read_text().splitlines()]
    assert words[:3] == [str(KEY), "0", "Car"] and words[4] == "3" and len(words) == 17
    numbers, is_area = read_labels(path)
    left, top, right, bottom = numbers[0, 5:9]
    assert left < right and top < bottom and not is_area.any()
    alpha, x, z, turn = numbers[0, [4, 12, 14, 15]]
    assert np.cos(alpha - turn + np.arctan2(x, z)) == pytest.approx(1, abs=1e-6)


def test_a_track_has_one_number_and_one_size_in_all_keys(tmp_path: Path) -> None:
    recording = exported(write_set(tmp_path / "whole"))
    before, after = (recording.boxes(key) for key in (KEY - 1, KEY))
    assert before is not None and after is not None
    assert [*before.track] == [*after.track] and len(before.track) == 1
    np.testing.assert_allclose(before.size_m[0, :2], after.size_m[0, :2])
    cut = exported(write_set(tmp_path / "cut", **{f"k{KEY}": 2.0})).boxes(KEY)
    assert cut is not None
    rear = [(b.T_lidar_box[0] @ [-b.size_m[0, 0] / 2, 0, 0, 1])[0] for b in (cut, after)]
    (other,) = street_results()[KEY - 1].tracks
    np.testing.assert_allclose(cut.size_m[0, 0], other.size_m[0], atol=1e-5)
    assert rear[0] == pytest.approx(rear[1], abs=0.05)  # the side that was seen keeps its place


def test_images_with_distortion_are_refused(tmp_path: Path) -> None:
    run = write_views(tmp_path / "run", {"image_02": "bent"})[0]
    refused("image_02", "--camera", run=run, to="kitti-tracking")
