# SPDX-License-Identifier: MIT
"""What the keys of a recording share: made once, the same whatever is asked for, and one at the
seams of the blocks that it is made in."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from densify.config import Config, resolve
from densify.config.cache import Cache
from densify.config.errors import InputError, SweepError
from densify.geometry import poses
from densify.geometry.types import Sweep
from densify.pipeline import recording as recording_module
from densify.pipeline import run as pipeline
from densify.pipeline import sweeps
from densify.pipeline.recording import Recording
from densify.pipeline.warnings import _warn_of_window
from densify.readers.street import Street
from tests.dataset_scenes import BORDER, across_border
from tests.scenes import Arc, Scanner, Scene, TinySequence, World, by_flow, car, street
from tests.small_street import POSES_GIVEN

LIMIT = 10**9
GIVEN = resolve(POSES_GIVEN)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of 6 keys, so that short recordings have many."""
    monkeypatch.setattr(sweeps, "BLOCK_S", 0.6)


@pytest.fixture(scope="module")
def long_street() -> TinySequence:
    """18 sweeps, two cars."""
    cars = car(10, -1.5, 6, 1), car(40, 2.2, 7, 2, np.pi)
    scene = Scene(World((*street(60.0), *cars)), Arc(0, -1.5, 0, 4.0), Scanner(32, 540))
    return TinySequence(scene, range(18))


def drive_of(sequence, folder: Path, window: int = 2, config: Config = GIVEN) -> Recording:
    return Recording(sequence, config, window, cache=Cache(LIMIT, folder), looks_around=True)


def maps_of(drive: Recording, key: int) -> pipeline.Result:
    return pipeline.densify(drive, key, ["flow"], with_images=False)["flow"]


def assert_same_maps(a, b) -> None:
    assert a.keys() == b.keys()
    for name in a:
        for field in ("depth_m", "filled_m", "confidence", "frame", "age_s"):
            np.testing.assert_array_equal(getattr(a[name], field), getattr(b[name], field), field)


class FromItsStart(TinySequence):
    """Its world is the lidar of its first sweep, as registration's is."""

    def T_world_lidar(self, frame: int) -> np.ndarray:
        start = super().T_world_lidar(self.frames[0])
        return poses.inverse(start) @ super().T_world_lidar(frame)


@pytest.mark.parametrize(("source", "num_sweeps"), [("dataset", 5), ("kiss-icp", 3)])
def test_a_recording_within_the_window_is_what_run_makes(
    source: str, num_sweeps: int, long_street, tmp_path: Path
) -> None:
    config, key = resolve({"register": {"source": source}}), num_sweeps - 1
    sequence = FromItsStart(long_street.scene, range(num_sweeps), with_truth=False)
    alone = pipeline.run(sequence, key, 4, config=config)
    here = maps_of(drive_of(sequence, tmp_path, 4, config), key)
    assert here.frames == alone.frames
    assert here.metrics["num_moving"] == alone.metrics["num_moving"] > 0
    assert_same_maps(here.depth, alone.depth)


def test_keys_do_not_depend_on_others(small_blocks, long_street, tmp_path: Path) -> None:
    """Nor on their order, nor on what is in memory or on disk already, near or far."""
    config = resolve({**POSES_GIVEN, "accumulate": {"far_m": 20.0}})
    upward, downward = (drive_of(long_street, tmp_path / n, config=config) for n in "ab")
    first = [maps_of(upward, key) for key in (5, 6)][1]
    frames = np.unique(first.cloud.frame[first.cloud.far])
    assert len(frames) > 0 and set(frames).isdisjoint(first.frames)
    assert first.far_frames == tuple(frames)
    assert_same_maps(maps_of(downward, 6).depth, first.depth)
    again = drive_of(long_street, tmp_path / "a", config=config)
    assert_same_maps(maps_of(again, 6).depth, first.depth)


def test_a_hole_in_time_ends_windows_and_begins_a_world(tmp_path: Path) -> None:
    holes = [BORDER + i for i in (-5, -4, -3, 3, 4, 5)]
    frames = [f for f in range(BORDER - 8, BORDER + 8) if f not in holes]
    drive = drive_of(across_border(frames), tmp_path, 4)
    pieces = {
        BORDER - 7: [-8, -7, -6],
        BORDER - 1: [-2, -1, 0, 1, 2],
        BORDER: [-2, -1, 0, 1, 2],
        BORDER + 6: [6, 7],
    }
    for key, around in pieces.items():
        window = drive.window(key)
        assert window.frames == tuple(BORDER + i for i in around)
    assert drive.motion(BORDER - 7).flow(BORDER - 7, BORDER - 7).displacement.shape[1] == 3
    assert "lie between frames" in drive.window_frames(BORDER - 1).cuts[0]
    end = drive.window(BORDER + 7)[BORDER + 7]
    np.testing.assert_array_equal(end.twist_before, end.twist_after)


@pytest.mark.parametrize("source", ["dataset", "kiss-icp"])
def test_windows_go_on_over_missing_sweeps_and_borders_of_blocks(
    source: str, small_blocks, tmp_path: Path
) -> None:
    frames = [f for f in range(BORDER - 6, BORDER + 6) if f not in (BORDER - 3, BORDER, BORDER + 3)]
    sequence = across_border(frames, Scanner(32, 540))
    drive = drive_of(sequence, tmp_path, 2, resolve({"register": {"source": source}}))
    assert len(drive.cut.blocks) == 2
    for row in range(2, len(frames) - 2):
        window = drive.window(frames[row])
        assert window.frames == tuple(frames[row - 2 : row + 3])
        for sweep in window.sweeps if source == "dataset" else ():
            T_world_key = sequence.T_world_lidar(frames[row])
            true = poses.inverse(T_world_key) @ sequence.T_world_lidar(sweep.frame)
            found = window.T_target_source(frames[row], sweep.frame)
            np.testing.assert_allclose(found, true, atol=1e-9)


class Damaged(TinySequence):
    """One sweep cannot be read, has no pose, is noise, or has next to no returns."""

    def __init__(self, sequence, bad: int, kind: str = "unreadable") -> None:
        super().__init__(sequence.scene, sequence.frames)
        self.bad, self.kind = bad, kind

    def __getitem__(self, frame: int) -> Sweep:
        sweep = super().__getitem__(frame)
        if frame == self.bad and self.kind == "unreadable":
            raise InputError(f"frame {frame}: truncated")
        if frame == self.bad and self.kind == "garbage":
            noise = np.random.default_rng(frame).uniform(-40, 40, sweep.points.shape)
            sweep = replace(sweep, points=noise)
        return sweep.select(slice(50)) if (frame, self.kind) == (self.bad, "sparse") else sweep

    def T_world_lidar(self, frame: int) -> np.ndarray:
        if frame == self.bad and self.kind == "posed":
            raise InputError(f"frame {frame}: no pose")
        return super().T_world_lidar(frame)


@pytest.mark.parametrize(
    ("kind", "bad"), [("unreadable", BORDER - 1), ("posed", BORDER + 2), ("garbage", BORDER - 1)]
)
def test_only_the_sweep_that_is_in_the_way_is_left_out(kind: str, bad: int, tmp_path: Path) -> None:
    sequence = Damaged(across_border(), bad, kind)
    drive = drive_of(sequence, tmp_path)
    for key in sequence.frames:
        if key == bad:
            with pytest.raises((InputError, SweepError), match=str(bad)) as error:
                drive.window(key)
            assert isinstance(error.value, SweepError) == (kind == "garbage")
            assert "\n" not in str(error.value)
            continue
        near = [f for f in sequence.frames if abs(f - key) <= 2]
        side = [f for f in near if (f < bad) == (key < bad) and f != bad]
        assert drive.window(key).frames == tuple(side)


def test_an_almost_empty_sweep_ends_the_window_beside_it(tmp_path: Path) -> None:
    sequence = Damaged(across_border(), BORDER + 1, "sparse")
    drive = drive_of(sequence, tmp_path, 1, resolve({"register": {"source": "kiss-icp"}}))
    window = drive.window_frames(BORDER)
    assert window.frames == (BORDER - 1, BORDER)
    assert f"sweep {BORDER + 1} has 50 points" in window.cuts[0]


def test_looking_around_changes_no_window(long_street) -> None:
    """Motion is found out from sweeps 2 to 11; what is accumulated, near and far, is from the same
    sweeps as without."""
    sequence = Damaged(long_street, 12)
    settings = [
        resolve({"register": {"source": "dataset"}, "flow": {"look_around_s": s}}) for s in (0, 0.4)
    ]
    recording = Recording(sequence, settings[1], 2, [8], looks_around=True)
    assert recording.window(8).frames == (6, 7, 8, 9, 10)
    assert recording.searched_stretch(8).frames == tuple(range(2, 12))
    plain, looking = (by_flow(sequence, 8, 2, config=config) for config in settings)
    assert looking.frames == plain.frames and looking.far_frames == plain.far_frames
    assert looking.metrics["num_moving"] == pytest.approx(plain.metrics["num_moving"], rel=0.02)


def test_a_key_that_cannot_be_made_costs_no_other(long_street) -> None:
    sequence = Damaged(long_street, 6)
    results = dict(pipeline.run_keys(sequence, [4, 6, 8], 2, config=GIVEN))
    assert isinstance(results[6], InputError) and "frame 6" in str(results[6])
    assert results[4].frames == (2, 3, 4, 5) and results[8].frames == (7, 8, 9, 10)


def test_a_cache_gives_the_same_bytes_and_saves_the_work(
    long_street, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    for cache in (None, Cache(LIMIT, tmp_path), Cache(LIMIT, tmp_path)):
        made += [pipeline.compare(long_street, 5, 2, None, GIVEN, None, ["flow"], cache)["flow"]]
        if cache is not None:
            monkeypatch.setattr(recording_module, "find_trajectory", pytest.fail)
            assert_same_maps(made[-1].depth, made[0].depth)


def test_of_two_sweeps_the_pair_alone_tells_what_moves() -> None:
    """A track shows itself in three."""

    class Two:
        frames = (100, 101)

        def __getattr__(self, name):
            return getattr(simulated, name)

        def __getitem__(self, frame):
            return simulated[frame]

    simulated = Street("street", 4711, "dual32", cameras=())
    recording = Recording(Two(), Config(), 1)
    assert recording.is_pair(100)
    found = recording.step(100)
    field, row = found.steps[100, 101], found.stretch[100].sweep.row
    true_m = simulated.truth.displacement(100, 101)[row]
    moves = np.linalg.norm(true_m, axis=1) > 0.05
    assert np.mean(field.moving[moves]) > 0.85 and field.moving[~moves].mean() < 0.005
    off_m = np.linalg.norm(field.displacement - true_m, axis=1)
    assert off_m[moves].mean() < 0.09 and off_m[moves & field.moving].mean() < 0.04
    assert any("two sweeps" in told for told in _warn_of_window(recording, 100, has_flow=True))
