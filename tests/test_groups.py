# SPDX-License-Identifier: MIT
"""Moving groups: what moves is found and moved right, and nothing else moves at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from densify import poses
from densify.config import FlowSettings
from densify.flow.evidence import FreeSpace, find_candidates, link
from densify.flow.tracks import Track
from densify.stages.flow import step_flow
from densify.types import FlowField, Window
from tests.scenes import SWEEP_S, Arc, Box, Scanner, Scene, World, car, street

SETTINGS = FlowSettings()
NOISE = Scanner(sigma_m=0.01)
KEY = 5


@dataclass
class Found:
    """A scene and the flow of each sweep of its window to the next one towards the key."""

    scene: Scene
    window: Window
    heights_m: list[np.ndarray]
    fields: tuple[FlowField, ...]

    @staticmethod
    def of(movers, ego=None, size=4, scanner=NOISE, extra=()) -> Found:
        scene = Scene(
            World((*street(), *extra, *movers)), ego or Arc(0, -1.5, 0, 6.0, 0.0), scanner
        )
        window = scene.window(KEY, size)
        heights_m = [scene.height_m(f) for f in window.frames]
        return Found(scene, window, heights_m, step_flow(window, heights_m, SETTINGS))

    def target(self, frame: int) -> int:
        return frame + int(np.sign(KEY - frame))

    def near_key(self, reach=3):
        """(frame, scan, field) of the sweeps within ``reach`` of the key."""
        for frame, flow in zip(self.window.frames, self.fields, strict=True):
            if abs(frame - KEY) <= reach:
                yield frame, self.scene.scan(frame), flow

    def errors_m(self, instance: int, reach=3) -> np.ndarray:
        """Of the instance's points that move: off the true displacement to the next sweep."""
        found = []
        for frame, scan, flow in self.near_key(reach):
            on = (scan.instance == instance) & flow.moving
            true = self.scene.displacement(frame, self.target(frame))
            found.append(np.linalg.norm(flow.displacement - true, axis=1)[on])
        return np.concatenate(found)

    def share_moving(self, instance: int, reach=3) -> float:
        moving = [f.moving[s.instance == instance] for _, s, f in self.near_key(reach)]
        return float(np.concatenate(moving).mean())

    def track_of(self, instance: int, reach=3) -> int:
        """The number most of the instance's moving points carry."""
        numbers = [
            f.instance[(s.instance == instance) & f.moving] for _, s, f in self.near_key(reach)
        ]
        return int(np.bincount(np.concatenate(numbers)).argmax())

    def false_share(self) -> float:
        """Of the points on what stands still: marked as moving."""
        frames = zip(self.window.frames, self.fields, strict=True)
        return float(
            np.concatenate([f.moving[self.scene.scan(k).instance < 0] for k, f in frames]).mean()
        )


# --- nothing moves --------------------------------------------------------------------------------


FOLIAGE = [
    Box((6, 1.5, 2.0), Arc(x, y), solid=0.5) for x, y in ((8, 5.5), (15, -6), (-6, 6), (20, 4.6))
]


@pytest.mark.parametrize(
    ("extra", "scanner", "ego"),
    [
        ((), Scanner(), Arc(0, -1.5, 0, 12.0, 0.2)),
        ((), Scanner(sigma_m=0.03), Arc(0, -1.5, 0, 12.0, -0.1)),
        ((), NOISE, Arc(0, -1.5)),
        (FOLIAGE, NOISE, Arc(0, -1.5, 0, 8.0, 0.1)),
        (FOLIAGE, Scanner(32, 900, (-25.0, 5.0), 0.02), Arc(0, -1.5, 0, 8.0, 0.1)),
    ],
    ids=["clean, turning", "noise", "standing", "foliage", "foliage, 32 beams"],
)
def test_a_static_world_has_no_flow_to_the_last_bit(extra, scanner, ego):
    found = Found.of((), ego, size=3, scanner=scanner, extra=extra)
    for flow in found.fields:
        assert not flow.moving.any() and not flow.lost.any()
        assert not flow.displacement.any()
        assert (flow.instance == -1).all()


# --- movers ---------------------------------------------------------------------------------------


CAR, FAST, WALKER = 1, 2, 3


@pytest.fixture(scope="module")
def traffic() -> Found:
    return Found.of(
        [
            car(14, -1.6, 10, CAR),
            car(8, 1.6, 30, FAST),
            car(12, 3.4, 1.5, WALKER, yaw=-np.pi / 2, size_m=(0.5, 0.5, 1.7)),
        ]
    )


@pytest.mark.parametrize("instance", [CAR, FAST, WALKER], ids=["10 m/s", "30 m/s", "walker"])
def test_movers_are_found_and_moved_right(traffic, instance):
    assert traffic.share_moving(instance) > 0.7
    errors = traffic.errors_m(instance)
    assert np.median(errors) < 0.05
    assert np.quantile(errors, 0.9) < 0.08


def test_each_mover_has_a_number_of_its_own(traffic):
    assert len({traffic.track_of(i) for i in (CAR, FAST, WALKER)}) == 3


def test_what_stands_still_beside_movers_stays(traffic):
    assert traffic.false_share() < 2e-4


def test_only_what_moves_is_displaced(traffic):
    for flow in traffic.fields:
        assert not flow.displacement[~flow.moving].any()
        assert np.array_equal(flow.moving, flow.instance >= 0)
        assert not flow.lost.any()


def test_the_keys_own_flow_is_zero_with_its_movers_marked(traffic):
    flow = traffic.fields[traffic.window.frames.index(KEY)]
    assert not flow.displacement.any()
    on = traffic.scene.scan(KEY).instance >= 0
    assert flow.moving[on].mean() > 0.7


def test_shapes_and_types(traffic):
    for registered, flow in zip(traffic.window.sweeps, traffic.fields, strict=True):
        n = len(registered.sweep)
        assert flow.displacement.shape == (n, 3) and flow.displacement.dtype == np.float64
        assert flow.moving.shape == (n,) and flow.moving.dtype == bool
        assert flow.instance.shape == (n,) and flow.instance.dtype == np.int32
        assert flow.lost.shape == (n,) and flow.lost.dtype == bool


def test_same_bytes_every_time(traffic):
    again = step_flow(traffic.window, traffic.heights_m, SETTINGS)
    for a, b in zip(traffic.fields, again, strict=True):
        assert a.displacement.tobytes() == b.displacement.tobytes()
        assert a.instance.tobytes() == b.instance.tobytes()


def test_a_turning_truck():
    truck = car(26, 1.5, 5, 1, yaw=np.pi * 0.75, turn_rad_s=0.4, size_m=(9.0, 2.4, 3.0))
    found = Found.of([truck], Arc(0, -1.5, 0, 3.0))
    assert found.share_moving(1) > 0.6
    errors = found.errors_m(1)
    assert np.median(errors) < 0.05 and np.quantile(errors, 0.9) < 0.08
    assert found.false_share() < 2e-4
    # its ends go different ways: a translation for all would be wrong
    true = found.scene.displacement(KEY + 1, KEY)[found.scene.scan(KEY + 1).instance == 1]
    assert np.ptp(true, axis=0).max() > 0.1


def test_cars_in_a_row_keep_their_own_motion():
    found = Found.of([car(8, 2.0, 11, 1), car(23, 2.0, 8, 2)], Arc(0, -1.5, 0, 8.0))
    assert found.track_of(1) != found.track_of(2)
    for instance, speed_m_s in ((1, 11), (2, 8)):
        assert found.share_moving(instance) > 0.7
        assert np.quantile(found.errors_m(instance), 0.9) < 0.08
        for frame, scan, flow in found.near_key():
            on = (scan.instance == instance) & flow.moving
            if frame != KEY:
                length = np.linalg.norm(flow.displacement[on], axis=1)
                assert np.median(length) == pytest.approx(0.1 * speed_m_s, abs=0.08)


def test_a_car_that_passes_behind_a_pillar():
    pillar = Box((0.8, 0.8, 5.0), Arc(15, -1.2))
    crossing = car(22, 3, 9, 1, yaw=-np.pi / 2)
    found = Found.of([crossing], Arc(0, -1.5, 0, 3.0), extra=[pillar])
    assert found.share_moving(1) > 0.7
    # on both sides of the pillar it is the same car
    before = [f.instance[(s.instance == 1) & f.moving] for k, s, f in found.near_key() if k < KEY]
    after = [f.instance[(s.instance == 1) & f.moving] for k, s, f in found.near_key() if k > KEY]
    same = np.bincount(np.concatenate(before)).argmax()
    assert same == np.bincount(np.concatenate(after)).argmax()
    assert np.median(found.errors_m(1)) < 0.15
    assert found.false_share() < 2e-4
    on_pillar = [f.moving[s.box == len(street())] for _, s, f in found.near_key()]
    assert not np.concatenate(on_pillar).any()


def test_ego_motion_is_no_motion():
    """Ego vehicles that stand, or drive and turn, see the same car move alike."""
    mover = car(16, 2.0, 9, 1)
    frame = KEY - 2
    for ego in (Arc(0, -1.5), Arc(-2, -1.5, 0.5, 6.0, -1.0)):
        found = Found.of([mover], ego)
        flow = found.fields[found.window.frames.index(frame)]
        on = flow.moving & (found.scene.scan(frame).instance == 1)
        R_world_lidar = found.scene.T_world_lidar(frame * SWEEP_S)[:3, :3]
        in_world = R_world_lidar @ np.median(flow.displacement[on], 0)
        np.testing.assert_allclose(in_world, [0.9, 0, 0], atol=0.1)


def test_a_window_of_one_sweep_has_no_flow():
    found = Found.of([car(14, -1.6, 10, 1)], size=0)
    assert len(found.fields) == 1
    assert not found.fields[0].displacement.any() and not found.fields[0].moving.any()


# --- evidence -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def evidence(traffic):
    return find_candidates(FreeSpace.of(traffic.window), traffic.heights_m, SETTINGS.min_height_m)


def test_candidates_are_where_their_rows_say(traffic, evidence):
    for registered, c in zip(traffic.window.sweeps, evidence, strict=True):
        placed = poses.transform(registered.T_key_lidar, registered.sweep.points[c.row])
        np.testing.assert_allclose(c.points, placed)
        assert len(c.row) == len(np.unique(c.row)) == len(c.seed) == len(c.cluster)
        assert set(np.unique(c.cluster)) == set(range(c.num_clusters))


def test_candidates_are_few_and_above_the_ground(traffic, evidence):
    for height_m, c in zip(traffic.heights_m, evidence, strict=True):
        assert (height_m[c.row] >= SETTINGS.min_height_m).all()
        assert 0 < len(c.row) < 0.1 * len(height_m)


def test_movers_are_seen_through_and_walls_are_not(traffic):
    space = FreeSpace.of(traffic.window)
    i, j = traffic.window.frames.index(KEY), traffic.window.frames.index(KEY + 4)
    scan, registered = traffic.scene.scan(KEY), traffic.window[KEY]
    points = poses.transform(registered.T_key_lidar, registered.sweep.points)
    free = space.seen_through(points, j)
    assert free[scan.instance == FAST].mean() > 0.5
    still = (scan.instance < 0) & (scan.box >= 0)
    assert free[still].mean() < 1e-3
    assert not space.seen_through(points, i).any()


def test_a_lower_limit_of_height_lets_less_in(traffic):
    space = FreeSpace.of(traffic.window)
    few = find_candidates(space, traffic.heights_m, 1.0)
    for height_m, c in zip(traffic.heights_m, few, strict=True):
        assert (height_m[c.row] >= 1.0).all()


def test_links_of_voxels():
    gap = [[0, 0, 0], [0.5, 0, 0], [1.0, 0, 0], [3.0, 0, 0], [3.3, 0, 0]]
    number, label = link(np.array(gap), 0.6)
    assert number == 2
    assert label[0] == label[1] == label[2] != label[3] == label[4]


def test_links_against_a_slow_twin():
    points = np.random.default_rng(3).uniform(-6, 6, (300, 3)) * [1, 1, 0.1]
    number, label = link(points, 0.6)
    assert set(label) == set(range(number)) and label.dtype == np.int64
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)

    def groups(reach):
        group = np.arange(len(points))
        for _ in range(len(points)):
            grown = np.array([group[row].min() for row in distance <= reach])
            if np.array_equal(grown, group):
                break
            group = grown
        return group

    # what is certainly close shares a label, what is certainly apart does not
    inner, outer = groups(0.6 - 0.3 * np.sqrt(3)), groups(0.6 + 0.3 * np.sqrt(3))
    for a, b in np.random.default_rng(0).integers(0, len(points), (3000, 2)):
        assert label[a] == label[b] or inner[a] != inner[b]
        assert label[a] != label[b] or outer[a] == outer[b]


def test_links_of_nothing():
    number, label = link(np.empty((0, 3)), 0.6)
    assert number == 0 and label.shape == (0,)


# --- tracks ---------------------------------------------------------------------------------------


def test_a_track_carries_points_along_its_smooth_motion():
    """3 m/s ahead while turning by 0.2 rad/s about the object's own centre."""
    smooth = np.array([[3.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.2, 0.0]])
    track = Track(centre=np.array([10.0, 5.0, 0.0]), smooth=smooth)
    ahead = np.array([[14.0, 5.0, 1.0]])  # at t = 0, 3 m before the centre that is at x = 11
    moved = track.carry(ahead, 0.0, 0.5)
    expected = [12.5 + 3 * np.cos(0.1), 5 + 3 * np.sin(0.1), 1.0]
    np.testing.assert_allclose(moved, [expected], atol=1e-12)
    np.testing.assert_allclose(track.carry(moved, 0.5, 0.0), ahead, atol=1e-12)
    assert np.allclose(track.carry(ahead, 0.3, 0.3), ahead)
