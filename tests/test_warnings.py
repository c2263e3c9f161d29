# SPDX-License-Identifier: MIT
"""A run says what it had to assume, and what looks wrong about its calibration and its clocks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

import densify
from densify.config import resolve
from densify.depth.confidence import expected_outliers
from densify.free_space.raw_sweeps import without_lone
from densify.geometry import poses
from densify.geometry.types import Camera
from densify.outputs import write_result
from densify.pipeline.recording import Recording
from densify.pipeline.run import run
from densify.pipeline.warnings import of_result
from densify.readers.timeline import choose_cameras
from densify.registration.compensation import find_compensated
from tests.command import exit_code
from tests.dataset_scenes import FRAMES, OPTIONS, copy_drive, records
from tests.scenes import CAMERA, Arc, Scanner, Scene, TinySequence, World, stamp_ns, street
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


class DropsOut(Changed):
    """A second scanner measures half of the points, but not in the key sweep."""

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        lidar = (np.arange(len(sweep)) % 2) * (frame != KEY)
        origins = np.zeros((2, 3))
        return replace(sweep, lidar=lidar.astype(sweep.lidar.dtype), scanner_origins=origins)


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
        (lambda: DropsOut(), f"sweeps {KEY} have no returns of scanner 1, which others have"),
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


def test_points_that_are_left_out_are_counted(tmp_path):
    class Cut(TinySequence):
        def __getitem__(self, frame):
            return replace(super().__getitem__(frame), num_untimed=700 * (frame == KEY + 1))

    usual = one_car()
    (told,) = warnings_of(Cut(usual.scene, usual.frames))
    assert told.startswith(f"700 points of sweeps {KEY + 1} are left out: their times lie outside")
    near = {"register": {"source": "dataset", "min_range_m": 8.0}}
    (told,) = run(one_car(), KEY, 1, "icp", config=POSES_GIVEN | near).warnings
    assert "register.min_range_m = 8 takes" in told and "% of the points as the own" in told


def compensated(sweep, twist, moment):
    """The sweep as a driver carries it to a moment of its own."""
    since_s = 1e-9 * (sweep.offset_ns - moment(sweep.offset_ns))
    points = poses.transform_each(since_s[:, None] * twist, sweep.points)
    return replace(sweep, points=points)


class Snowy(TinySequence):
    """The small street in snow: a share of the returns comes from flakes before the surfaces."""

    share = 0.08

    def __getitem__(self, frame):
        rng, sweep = np.random.default_rng(frame), super().__getitem__(frame)
        flake = rng.random(len(sweep)) < self.share
        before = np.where(flake, rng.random(len(sweep)), 1.0)
        return replace(sweep, points=sweep.points * before[:, None])


def test_snow_is_no_motion_and_is_told():
    usual = one_car()
    clear, snowy = (
        run(sequence, KEY, 2, "flow", config=POSES_GIVEN)
        for sequence in (usual, Snowy(usual.scene, usual.frames))
    )
    assert not any("snow" in warning for warning in clear.warnings)
    (told,) = [warning for warning in snowy.warnings if "snow" in warning]
    assert "% of the points are lone returns, as of snow, rain or dust" in told
    moving = clear.cloud.moving.sum()
    assert 0.6 * moving < snowy.cloud.moving.sum() < 1.2 * moving


@pytest.mark.parametrize(
    "place",
    ["kitti/2011_09_26/2011_09_26_drive_0013_sync", "pandaset/002", "nuscenes", "ddad"],
)
def test_good_weather_is_left_as_it_is(place, test_data):
    sequence = densify.open_sequence(test_data / place)
    sweep = sequence[sequence.frames[0]]
    assert without_lone(sweep) is sweep


STAMP, FIRST, LAST = (lambda ns: 0), np.min, np.max


@pytest.mark.parametrize(
    ("moment", "says"), [(STAMP, "its stamp"), (FIRST, "its first point"), (LAST, "its last point")]
)
@pytest.mark.parametrize("source", ["dataset", "kiss-icp"])
def test_sweeps_that_are_compensated_already_are_told(moment, says, source):
    class Carried(TinySequence):
        def __getitem__(self, frame):
            return compensated(super().__getitem__(frame), [0, 0, 0, 4.0, 0, 0], moment)

    usual, settings = one_car(), POSES_GIVEN | {"register": {"source": source}}
    told = run(Carried(usual.scene, usual.frames), KEY, 1, "icp", config=settings).warnings
    assert sum(f"compensated already, to {says}, and now a second time" in w for w in told) == 1
    assert not any("compensated" in w for w in run(usual, KEY, 1, "icp", config=settings).warnings)


@pytest.mark.parametrize("drive", ["2011_09_26_drive_0002_sync", "2011_09_26_drive_0013_sync"])
def test_real_sweeps_are_told_as_they_are(drive, test_data):
    sequence = densify.open_sequence(test_data / "kitti" / "2011_09_26" / drive)
    key = sequence.frames[5]
    T = [sequence.T_world_lidar(f) for f in (key - 1, key + 1)]
    twist = poses.twist_between(
        *T, 1e-9 * (sequence.stamp_ns(key + 1) - sequence.stamp_ns(key - 1))
    )
    assert find_compensated(sequence[key], twist, 0.1) is None
    for moment, says in ((STAMP, "its stamp"), (FIRST, "its first point")):
        rings = find_compensated(compensated(sequence[key], twist, moment), twist, 0.1)
        assert rings is not None and rings.moment == says


WRONG_POSES = {
    "m/s up beside": lambda T, s: shifted(0, 0, 0.2 * s) @ T,
    "% too long": lambda T, s: shifted(*(0.04 * T[:3, 3])) @ T,
    "deg from": lambda T, s: T @ poses.exp(np.array([0, 0, np.deg2rad(2) * s, 0, 0, 0])),
}


@pytest.mark.parametrize("kind", WRONG_POSES)
def test_poses_that_the_sweeps_contradict_are_told(kind):
    class Wrong(TinySequence):
        def T_world_lidar(self, frame):
            T = super().T_world_lidar(frame)
            return WRONG_POSES[kind](T, 0.1 * frame)

    usual = one_car()
    told = run(Wrong(usual.scene, usual.frames), KEY, 3, "icp", config=POSES_GIVEN).warnings
    (found,) = [w for w in told if "the recording's poses are off by" in w]
    assert kind in found and "--set register.source=kiss-icp" in found
    own = POSES_GIVEN | {"register": {"source": "kiss-icp"}}
    told = run(Wrong(usual.scene, usual.frames), KEY, 3, "icp", config=own).warnings
    assert not any("poses" in w for w in told)


@pytest.mark.parametrize("is_compensated", [False, True])
def test_maps_of_sweeps_without_times_know_it(is_compensated):
    """They are smeared, unless the sweeps are compensated already."""

    class Untimed(TinySequence):
        def __getitem__(self, frame):
            sweep = super().__getitem__(frame)
            if is_compensated:
                sweep = compensated(sweep, [0, 0, 0, 30.0, 0, 0], STAMP)
            return replace(sweep, offset_ns=None)

    fast = Scene(World(street(50.0)), Arc(0, -1.5, 0, 30.0), Scanner(48, 720))
    timed, untimed = (
        expected_outliers(run(sequence, KEY, 1, "flow", config=POSES_GIVEN).depth["front"])
        for sequence in (TinySequence(fast, range(7)), Untimed(fast, range(7)))
    )
    more = untimed["measured"] / timed["measured"]
    assert more < 2 if is_compensated else more > 10


def test_more_moving_points_than_there_can_be_are_told():
    result = run(one_car(), KEY, 1, "icp", config=POSES_GIVEN)
    moving = replace(result.cloud, moving=np.arange(len(result.cloud)) % 5 < 2)
    stretch = Recording(one_car(), resolve(POSES_GIVEN), 1, [KEY]).window(KEY)
    (told,) = of_result(replace(result, cloud=moving), stretch)
    assert told.startswith("40 % of the points move, more than in any traffic")


def test_a_run_of_empty_maps_fails(border_drive, tmp_path, capsys):
    drive = copy_drive(border_drive, tmp_path / "2011_09_26")
    path = drive.parent / "calib_velo_to_cam.txt"
    R, _, _ = path.read_text().partition("T:")
    path.write_text(f"{R}T: 0 900 0\n")
    settings = (*OPTIONS, "--method", "icp", "--out", tmp_path / "out")
    assert exit_code("run", drive, "--key", FRAMES[4], *settings) == 1
    told = capsys.readouterr().err.splitlines()
    assert told[-1].startswith("densify: every depth map is empty; are calibration and stamps")
    assert (tmp_path / "out" / f"{FRAMES[4]:06d}" / "run.yaml").is_file()


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
