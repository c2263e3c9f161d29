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
from densify.free_space.raw_sweeps import remove_lone_returns
from densify.geometry import poses
from densify.geometry.twists import move_with_twists
from densify.outputs.key_outputs import write_result
from densify.pipeline.recording import Recording
from densify.pipeline.run import run
from densify.pipeline.warnings import warn_of_result
from densify.readers.timeline import choose_cameras
from densify.registration.deskew import find_compensated
from tests.command import exit_code
from tests.dataset_scenes import FRAMES, OPTIONS, copy_drive, records
from tests.scenes import CAMERA, Arc, Scanner, Scene, TinySequence, World, stamp_ns, street
from tests.small_street import KEY, POSES_GIVEN, one_car


class Changed(TinySequence):
    """The small street with other cameras, image stamps (ms), sweeps and poses."""

    def __init__(self, sweep=None, *, cameras=(CAMERA,), images_ms=None, pose=None, gaps=()):
        usual = one_car()
        super().__init__(usual.scene, usual.frames)
        self.cameras = {camera.name: camera for camera in cameras}
        self._sweep, self._images_ms, self._pose, self._gaps = sweep, images_ms, pose, gaps

    def image_stamps_ns(self, camera):
        if self._images_ms is None:
            return super().image_stamps_ns(CAMERA.name)
        return {n: stamp_ns(0) + ms * 10**6 for n, ms in self._images_ms.get(camera, {}).items()}

    def image(self, camera, number):
        return np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8)

    def __getitem__(self, frame):
        sweep = super().__getitem__(frame)
        return self._sweep(sweep) if self._sweep else sweep

    def T_world_lidar(self, frame):
        T = super().T_world_lidar(frame)
        return self._pose(T, 0.1 * frame) if self._pose else T

    def gaps(self):
        return self._gaps


def shifted(*by_m: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = by_m
    return T


def untimed(sweep):
    return replace(sweep, offset_ns=None)


def dropping_out(sweep):
    """A second scanner measures half of the points, but not in the key sweep."""
    lidar = (np.arange(len(sweep)) % 2) * (sweep.frame != KEY)
    origins = np.zeros((2, 3))
    return replace(sweep, lidar=lidar.astype(sweep.lidar.dtype), scanner_origins=origins)


def snowing(sweep):
    """Snow: a share of the returns comes from flakes before the surfaces."""
    rng = np.random.default_rng(sweep.frame)
    flake = rng.random(len(sweep)) < 0.08
    before = np.where(flake, rng.random(len(sweep)), 1.0)
    return replace(sweep, points=sweep.points * before[:, None])


def compensated(sweep, twist, moment):
    """The sweep as a driver carries it to a moment of its own."""
    since_s = 1e-9 * (sweep.offset_ns - moment(sweep.offset_ns))
    points = move_with_twists(sweep.points, since_s, twist, twist)
    return replace(sweep, points=points)


STAMP, FIRST, LAST = (lambda ns: 0), np.min, np.max
TWIST = [0, 0, 0, 4.0, 0, 0]  # of the small street's lidar
TWO = [CAMERA, replace(CAMERA, name="rear")]
UPSIDE_DOWN = replace(
    CAMERA, T_cam_lidar=np.diag([1.0, -1, -1, 1]) @ shifted(0, 500, 0) @ CAMERA.T_cam_lidar
)
INVERTED = replace(CAMERA, T_cam_lidar=poses.inverse(CAMERA.T_cam_lidar))
ODOMETRY = {"source": "kiss-icp"}
TWICE = "compensated already, to {}, and now a second time".format
LOOKS_WRONG = [
    (Changed(gaps=["a file is missing"]), "a file is missing", {}),
    (Changed(untimed), "the points have no times of their own", {}),
    (Changed(dropping_out), f"sweeps {KEY} have no returns of scanner 1, which others have", {}),
    (
        Changed(images_ms={"front": {0: 10**12}}),
        "front: no image belongs to the sweep, the nearest was taken 1e+09 s away",
        {},
    ),
    (Changed(cameras=[UPSIDE_DOWN]), "0.00 % of the pixels have a measured depth", {}),
    (Changed(cameras=[UPSIDE_DOWN]), "front hangs upside down by its T_cam_lidar", {}),
    (Changed(cameras=[INVERTED]), "front lies on its side by its T_cam_lidar", {}),
    (
        Changed(cameras=TWO, images_ms={"front": {3: 300}}),
        "rear is left out: the recording has no images of it",
        {},
    ),
    (
        Changed(lambda sweep: replace(sweep, num_untimed=700 * (sweep.frame == KEY + 1))),
        f"700 points of sweeps {KEY + 1} are left out: their times lie outside",
        {},
    ),
    (one_car(), "register.min_range_m = 8 takes", {"min_range_m": 8.0}),
    (Changed(lambda sweep: compensated(sweep, TWIST, STAMP)), TWICE("its stamp"), {}),
    (Changed(lambda sweep: compensated(sweep, TWIST, FIRST)), TWICE("its first point"), ODOMETRY),
    (Changed(lambda sweep: compensated(sweep, TWIST, LAST)), TWICE("its last point"), {}),
]


@pytest.mark.parametrize(("sequence", "says", "register"), LOOKS_WRONG)
def test_what_looks_wrong_is_said(sequence, says, register, tmp_path):
    config = POSES_GIVEN | {"register": {"source": "dataset"} | register}
    result = run(sequence, KEY, 1, "icp", config=config)
    assert sum(says in warning for warning in result.warnings) == 1, result.warnings
    write_result(result, tmp_path, config={}, data="tiny")
    record = yaml.safe_load((tmp_path / f"{KEY:06d}" / "run.yaml").read_text())
    assert set(result.warnings) <= set(record["warnings"])


def test_nothing_is_said_of_what_is_right():
    undeskewed = {"register": {"source": "dataset", "deskew": False}}
    for sequence, config in ((one_car(), {}), (Changed(untimed), undeskewed)):
        assert run(sequence, KEY, 1, "icp", config=POSES_GIVEN | config).warnings == ()
    own_poses = run(one_car(), KEY, 1, "icp", config={"register": ODOMETRY})
    assert not any("compensated" in warning for warning in own_poses.warnings)


def test_snow_is_no_motion_and_is_told():
    clear, snowy = (
        run(sequence, KEY, 2, "flow", config=POSES_GIVEN)
        for sequence in (one_car(), Changed(snowing))
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
    assert remove_lone_returns(sweep) is sweep


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
    wrong = Changed(pose=WRONG_POSES[kind])
    told = run(wrong, KEY, 3, "icp", config=POSES_GIVEN).warnings
    (error,) = [w for w in told if "the recording's poses are off by" in w]
    assert kind in error and "--set register.source=kiss-icp" in error
    if kind == "deg from":
        own = POSES_GIVEN | {"register": ODOMETRY}
        assert not any("poses" in w for w in run(wrong, KEY, 3, "icp", config=own).warnings)


def test_maps_of_sweeps_without_times_know_it():
    """They are smeared, unless the sweeps are compensated already."""

    class Untimed(TinySequence):
        moment = None

        def __getitem__(self, frame):
            sweep = super().__getitem__(frame)
            if self.moment is not None:
                sweep = compensated(sweep, [0, 0, 0, 30.0, 0, 0], self.moment)
            return untimed(sweep)

    fast = Scene(World(street(50.0)), Arc(0, -1.5, 0, 30.0), Scanner(48, 720))
    straight = Untimed(fast, range(7))
    straight.moment = STAMP
    timed, smeared, undone = (
        expected_outliers(run(sequence, KEY, 1, "flow", config=POSES_GIVEN).depth["front"])[
            "measured"
        ]
        for sequence in (TinySequence(fast, range(7)), Untimed(fast, range(7)), straight)
    )
    assert smeared > 10 * timed and undone < 2 * timed


def test_more_moving_points_than_there_can_be_are_told():
    result = run(one_car(), KEY, 1, "icp", config=POSES_GIVEN)
    moving = replace(result.cloud, moving=np.arange(len(result.cloud)) % 5 < 2)
    stretch = Recording(one_car(), resolve(POSES_GIVEN), 1, [KEY]).window(KEY)
    (told,) = warn_of_result(replace(result, cloud=moving), stretch)
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


def test_sweeps_far_apart_follow_less_well():
    usual = one_car()
    every_second = TinySequence(usual.scene, usual.frames[1::2])
    for method, says in (("flow", True), ("icp", False)):
        found = run(every_second, KEY, 1, method, config=POSES_GIVEN).warnings
        assert any("sweeps are 0.2 s apart" in warning for warning in found) == says


def test_cameras_without_images_are_left_out_unless_none_has_any():
    for images_ms, names in (({"front": {3: 300}}, ["front"]), ({}, ["front", "rear"])):
        sequence = Changed(cameras=TWO, images_ms=images_ms)
        assert [camera.name for camera in choose_cameras(sequence, None)] == names
        assert [camera.name for camera in choose_cameras(sequence, ["rear"])] == ["rear"]


def test_a_set_ends_with_its_warnings_and_keeps_them(border_drive, tmp_path, capsys):
    drive, out = copy_drive(border_drive, tmp_path / "2011_09_26"), tmp_path / "out"
    (drive / "velodyne_points" / "timestamps_start.txt").unlink()
    settings = (*OPTIONS, "--layout", "densify", "--method", "icp", "--keys", "36:39")
    assert exit_code("dataset", "--data", drive, *settings, "--out", out) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "warning" in line]
    untimed = (
        "the points have no times of their own: motion within a sweep is not undone, and unless "
        "that was done before, confidence is low on purpose; densify doctor says what to do"
    )
    lacks = f"{drive / 'velodyne_points'} has no timestamps_start.txt"
    begin = f"densify: warning: {drive.name} key 36-38: "
    assert told[:2] == [begin + lacks, begin + untimed]
    assert [line.rpartition(": ")[2] for line in told[2:]] == [
        "the recording begins at frame 36"
    ] * 2
    for record in records(out):
        assert len(record["warnings"]) == 3 - (record["key"] == 38)  # its window of 2 is not cut
        (path,) = out.glob(f"**/{record['key']:06d}/run.yaml")
        assert yaml.safe_load(path.read_text())["warnings"] == record["warnings"]
