# SPDX-License-Identifier: MIT
"""A run says what it had to assume, and what looks wrong about its calibration and its clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from densify.geometry.types import Camera
from densify.outputs import write_result
from densify.pipeline.run import run
from densify.readers.timeline import choose_cameras
from tests.command import exit_code
from tests.dataset_scenes import FRAMES, OPTIONS, copy_drive, records
from tests.scenes import CAMERA, TinySequence, stamp_ns
from tests.small_street import KEY, POSES_GIVEN, one_car


class Changed(TinySequence):
    """The small street with other cameras, image stamps (ms) and times of points."""

    def __init__(self, cameras=(CAMERA,), images_ms=None, times=None):
        usual = one_car()
        super().__init__(usual.scene, usual.frames)
        self.cameras = {camera.name: camera for camera in cameras}
        self._images_ms, self._times = images_ms, times

    def image_stamps_ns(self, camera):
        if self._images_ms is None:
            return super().image_stamps_ns(CAMERA.name)
        return {n: stamp_ns(0) + ms * 10**6 for n, ms in self._images_ms.get(camera, {}).items()}

    def image(self, camera, number):
        return np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8)

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        return sweep if self._times is None else replace(sweep, offset_ns=self._times(sweep))

    def gaps(self):
        return ["a file is missing"] if self._times is None else []


def moved(T_change) -> Camera:
    return replace(CAMERA, T_cam_lidar=T_change @ CAMERA.T_cam_lidar)


def warnings_of(sequence, **options) -> tuple[str, ...]:
    return run(sequence, KEY, 1, "icp", config=POSES_GIVEN, **options).warnings


def test_nothing_is_said_of_what_is_right():
    assert warnings_of(one_car()) == ()


@pytest.mark.parametrize(
    ("sequence", "says"),
    [
        (lambda: Changed(), "a file is missing"),
        (lambda: Changed(times=lambda sweep: None), "the points have no times of their own"),
        (
            lambda: Changed(images_ms={"front": {0: 10**12}}),
            "front: no image belongs to the sweep, the nearest was taken 1e+09 s away",
        ),
        (
            lambda: Changed([moved(np.diag([1.0, -1, -1, 1]) @ shifted(0, 500, 0))]),
            "0.00 % of the pixels have a measured depth",
        ),
        (
            lambda: Changed([CAMERA, replace(CAMERA, name="rear")], {"front": {3: 300}}),
            "rear is left out: the recording has no images of it",
        ),
    ],
)
def test_what_looks_wrong_is_said(sequence, says, tmp_path):
    result = run(sequence(), KEY, 1, "icp", config=POSES_GIVEN)
    assert sum(says in warning for warning in result.warnings) == 1, result.warnings
    write_result(result, tmp_path, config={}, data="tiny")
    record = yaml.safe_load((tmp_path / f"{KEY:06d}" / "run.yaml").read_text())
    assert set(result.warnings) <= set(record["warnings"])


def shifted(*by_m: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = by_m
    return T


def test_sweeps_far_apart_follow_less_well():
    usual = one_car()
    every_second = TinySequence(usual.scene, usual.frames[1::2])
    for method, says in (("flow", True), ("icp", False)):
        found = run(every_second, KEY, 1, method, config=POSES_GIVEN).warnings
        assert any("sweeps are 0.2 s apart" in warning for warning in found) == says


def test_times_that_were_not_wanted_are_not_missed():
    config = {**POSES_GIVEN, "register": {"source": "dataset", "deskew": False}}
    sequence = Changed(times=lambda sweep: None)
    assert run(sequence, KEY, 1, "icp", config=config).warnings == ()


def test_cameras_without_images_are_left_out_unless_none_has_any():
    rear = replace(CAMERA, name="rear")
    cameras = Changed([CAMERA, rear], {"front": {3: 300}})
    assert [camera.name for camera in choose_cameras(cameras, None)] == ["front"]
    assert [camera.name for camera in choose_cameras(cameras, ["rear"])] == ["rear"]
    nowhere = Changed([CAMERA, rear], {})
    assert [camera.name for camera in choose_cameras(nowhere, None)] == ["front", "rear"]


def test_a_set_ends_with_its_warnings_and_keeps_them(border_drive, tmp_path, capsys):
    drive, out = copy_drive(border_drive, tmp_path / "2011_09_26"), tmp_path / "out"
    (drive / "velodyne_points" / "timestamps_start.txt").unlink()
    first, settings = FRAMES[0], (*OPTIONS, "--layout", "densify", "--method", "icp")
    keys = ("--keys", f"{first}:{first + 3}")
    assert exit_code("dataset", "--data", drive, *settings, *keys, "--out", out) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    untimed = "the points have no times of their own: motion within a sweep is not undone"
    ends = f"the recording begins at frame {first}"
    assert told[:2] == [
        f"densify: warning: {drive.name} key 36-38: {drive / 'velodyne_points'} has no "
        f"timestamps_start.txt",
        f"densify: warning: {drive.name} key 36-38: {untimed}",
    ]
    assert [line.rpartition(": ")[2] for line in told[2:]] == [ends, ends]  # of window 2
    for record in records(out):
        cut = record["key"] < first + 2
        assert untimed in record["warnings"] and len(record["warnings"]) == 2 + cut
        (path,) = out.glob(f"**/{record['key']:06d}/run.yaml")
        assert yaml.safe_load(path.read_text())["warnings"] == record["warnings"]
