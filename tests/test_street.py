# SPDX-License-Identifier: MIT
"""The built-in street: its truth against slow twins, its scenes against geometry, its cache."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from densify.geometry.poses import inverse, transform
from densify.readers.street import Street
from densify.street.cameras import through_glass
from densify.street.lidar import laser
from densify.street.mesh import Material, Mesh, box
from densify.street.models import WHEELBASE_M, model
from densify.street.motion import Poses, Still
from densify.street.scenes import Scene
from densify.street.simulator import Simulator, build_scene, seconds
from densify.street.world import STOPS, Body, Rays, World
from tests.exported import refusal

KEY = 120
PERIOD_NS = 100_000_000


def _fixture(spec: str):
    return pytest.fixture(scope="module")(lambda: Street.from_spec(spec))


street, static = map(_fixture, ("street", "street:static"))
crossing, highway = map(_fixture, ("street:crossing?sensor=vlp16", "street:highway?sensor=vlp16"))

# The last two scenes that were built are kept: tests of one scene stand together.

# truth


def test_static_points_have_exactly_no_flow_and_movers_that_of_their_body(street):
    truth, displacement = street.truth.sweep(KEY), street.truth.displacement(KEY, KEY + 3)
    assert np.all(displacement[~truth.moving] == 0.0)
    assert np.linalg.norm(displacement[truth.moving], axis=1).max() > 2.0
    # a slow twin: one point at a time, through (4,4) matrices
    simulator, returns = street.simulator, street.returns(KEY)
    world = simulator.scene.world
    rng = np.random.default_rng(0)
    for row in rng.choice(np.flatnonzero(truth.moving), 25, replace=False):
        body = world.bodies[returns.body[row]].trajectory

        def T_world_body(time_ns, body=body):
            return body.poses(np.array([seconds(time_ns)])).matrices()[0]

        fired = street.stamp_ns(KEY) + int(returns.offset_ns[row])
        p_lidar = np.append(returns.points[row].astype(float), 1.0)
        p_body = inverse(T_world_body(fired)) @ simulator.T_world_lidar_at(fired) @ p_lidar
        T_lidar_world = inverse(street.T_world_lidar(KEY))
        here = T_lidar_world @ T_world_body(street.stamp_ns(KEY)) @ p_body
        there = T_lidar_world @ T_world_body(street.stamp_ns(KEY + 3)) @ p_body
        np.testing.assert_allclose(truth.points[row], here[:3], atol=1e-6)
        np.testing.assert_allclose(displacement[row], (there - here)[:3], atol=1e-6)


def test_nothing_moves_in_the_static_street_and_parked_cars_never_do(street, static):
    assert not static.truth.sweep(KEY).moving.any()
    assert not static.truth.moving_mask("image_02", KEY).any()
    truth = street.truth.sweep(KEY)
    assert truth.moving.sum() > 2000
    parked = truth.instance >= 1000
    assert parked.sum() > 2000
    assert not truth.moving[parked].any()
    assert not truth.moving[truth.instance == -1].any()


def test_depth_agrees_with_the_lidar(street):
    camera = "image_03"
    depth, moving = street.truth.depth_m(camera, KEY), street.truth.moving_mask(camera, KEY)
    truth, cam = street.truth.sweep(KEY), street.cameras[camera]
    delay_ns = street.image_stamps_ns(camera)[KEY] - street.stamp_ns(KEY)
    assert delay_ns == 15_000_000
    T_world_lidar = street.simulator.T_world_lidar_at(street.image_stamps_ns(camera)[KEY])
    world = transform(truth.T_world_lidar, truth.points[~truth.moving])
    p_cam = transform(cam.T_cam_lidar @ inverse(T_world_lidar), world)
    p_cam = p_cam[p_cam[:, 2] > 1]
    u, v = np.rint((p_cam @ cam.K.T)[:, :2] / p_cam[:, 2:]).astype(int).T
    seen = (u >= 0) & (u < cam.width_px) & (v >= 0) & (v < cam.height_px)
    error = depth[v[seen], u[seen]] - p_cam[seen, 2]
    error = error[(depth[v[seen], u[seen]] > 0) & ~moving[v[seen], u[seen]]]
    assert len(error) > 8000
    assert np.median(np.abs(error)) < 0.04
    assert np.mean(np.abs(error) < 0.3) > 0.85
    assert depth.dtype == np.float32 and depth.max() <= 120.0
    assert np.all(depth[0, 500:700] == 0)  # sky


# sweeps


def test_a_sweep_is_as_large_as_a_real_one_and_turns_clockwise(street):
    sweep = street[KEY]
    assert 100_000 < len(sweep) < 135_000
    range_m = np.linalg.norm(sweep.points, axis=1)
    assert range_m.min() > 1.0 and range_m.max() < 100.0
    assert sweep.intensity.min() >= 0 and sweep.intensity.max() <= 1
    assert np.all(np.diff(sweep.offset_ns) > 0)  # no two pulses at once
    assert sweep.offset_ns.min() < -49_000_000 and sweep.offset_ns.max() > 49_000_000
    azimuth = np.arctan2(sweep.points[:, 1], sweep.points[:, 0])
    assert np.abs(-azimuth / (2 * np.pi) * PERIOD_NS - sweep.offset_ns).max() < 20


def _columns(street: Street, frame: int) -> list[np.ndarray]:
    """All that is rendered of a frame, with its truth."""
    sweep, truth = street[frame], street.truth.sweep(frame)
    picture = street.picture("fast", frame)
    columns = [sweep.points, sweep.intensity, sweep.offset_ns, truth.points]
    return [*columns, picture.image, picture.depth_m, picture.body, street.bodies.moving]


def test_fresh_and_cached_frames_are_the_same_bytes(tmp_path, monkeypatch):
    spec, frames = "street:highway?sensor=vlp16&cameras=fast", (30, 31, 32)
    plain = Street.from_spec(spec)
    plain.keep_nothing()
    alone = [_columns(plain, frame) for frame in frames]
    build_scene.cache_clear()
    monkeypatch.setenv("DENSIFY_CACHE_DIR", str(tmp_path))
    together = Street.from_spec(spec)
    together.prepare(frames, [("fast", frame) for frame in frames])  # in threads
    assert together.simulator.scene is not plain.simulator.scene
    assert together.bodies.moving.any()
    cached = Street.from_spec(spec)
    monkeypatch.setattr(Simulator, "returns", None)  # nothing is left to be rendered
    monkeypatch.setattr(Simulator, "picture", None)
    for frame, expected in zip(frames, alone, strict=True):
        for column, wanted in zip(_columns(cached, frame), expected, strict=True):
            assert column.tobytes() == wanted.tobytes()


class _Sliding:
    """10 m/s to the left."""

    def poses(self, times_s):
        n = len(times_s)
        away = np.column_stack([np.zeros(n), 10.0 * times_s, np.zeros(n)])
        return Poses(np.broadcast_to(np.eye(3), (n, 3, 3)), away)


def test_each_ray_meets_a_moving_body_where_it_is_then():
    slider = Body(box((9, -1, -1), (11, 1, 1), Material.BODYWORK), _Sliding(), 0)
    world = World([Body(box((29, -50, -9), (30, 50, 9), Material.CONCRETE), Still()), slider])
    times = np.repeat(np.linspace(-0.05, 0.05, 11), 41)
    y = np.tile(np.linspace(-2.05, 2.05, 41), 11)
    direction = np.column_stack([np.full(len(y), 9.0), y, np.zeros(len(y))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = Rays(np.zeros((len(y), 3)), direction, times)
    hits = world.cast(rays, lambda met: np.full(len(met.ray), STOPS))
    at = hits.range_m[:, None] * direction
    on_face = np.abs(y - 10 * times) < 1 - 1e-6
    np.testing.assert_allclose(at[on_face, 0], 9.0, atol=1e-9)
    assert np.all(world.triangles.body[hits.triangle[on_face]] == 1)
    far = np.abs(y - 10 * times) > 1 + 0.3  # its side faces are seen close by
    np.testing.assert_allclose(at[far, 0], 29.0, atol=1e-9)


def test_leaves_let_their_share_of_rays_through_and_glass_light():
    n = 4000
    wall = box((5, -9, -9), (6, 9, 9), Material.CONCRETE)
    rays = Rays(np.zeros((n, 3)), np.tile([1.0, 0, 0], (n, 1)), np.zeros(n))
    sheet = np.array([[[2.0, -1, -1], [2, 1, -1], [2, 1, 1], [2, -1, 1]]])
    for material, share, light in ((Material.LEAF, 0.45, False), (Material.GLASS, None, True)):
        world = World([Body(Mesh.join([wall, Mesh.quads(sheet, material)]), Still())])
        assert (world.cast(rays, through_glass(world)).range_m > 4).all() == light
        if share is not None:
            luck = np.random.default_rng(0).random(n)
            passed = world.cast(rays, laser(world, luck)).range_m > 4
            assert abs(passed.mean() - share) < 0.03


# what is there, and how it moves


def _vertices_at(body: Body, time_s: float) -> np.ndarray:
    return transform(body.trajectory.poses(np.array([time_s])).matrices()[0], body.mesh.vertices)


_LATTICE = np.stack(np.meshgrid(*[np.linspace(0, 1, k) for k in (9, 5, 3)]), -1).reshape(-1, 3)


def _check_no_contact(scene: Scene) -> None:
    """A twin of the placement's own test: no point of one's upright box in that of another."""
    bodies = [b for actor in scene.actors for b in actor.bodies]
    owner = np.array([-1, *(i for i, actor in enumerate(scene.actors) for _ in actor.bodies)])
    boxes = [Body(model("ego_vehicle"), scene.ego), *bodies]
    bounds = [b.mesh.bounds for b in boxes]
    standing = scene.footprints
    sideways = np.stack([-standing.forward[:, 1], standing.forward[:, 0]], axis=1)
    axes = np.stack([standing.forward, sideways], axis=1)
    for time in np.arange(0.0, 16.0, 0.4):
        matrices = [b.trajectory.poses(np.array([time])).matrices()[0] for b in boxes]
        clouds = [
            transform(T, low + _LATTICE * (high - low))
            for T, (low, high) in zip(matrices, bounds, strict=True)
        ]
        centres = np.array([c.mean(axis=0) for c in clouds])
        for i, (low, high) in enumerate(bounds):
            near = np.linalg.norm(centres - centres[i], axis=1) < 20
            for j in np.flatnonzero(near & (owner != owner[i])):
                p = transform(inverse(matrices[i]), clouds[j])
                assert not ((p > low) & (p < high)).all(axis=1).any(), (time, owner[i], owner[j])
            close = np.linalg.norm(standing.centre - centres[i][:2], axis=1) < 20
            away = clouds[i][:, None, :2] - standing.centre[close]
            offsets = np.einsum("pni,nai->pna", away, axes[close])
            assert not (np.abs(offsets) < standing.half_m[close]).all(axis=-1).any(), time


def test_nobody_touches_anybody(street, crossing, highway):
    scenes = [sequence.simulator.scene for sequence in (street, crossing, highway)]
    for scene in scenes:
        count = Counter(actor.name for actor in scene.actors)
        assert count["car"] >= 7 and count["truck"] >= 1
        assert scene is scenes[2] or (count["cyclist"] >= 1 and count["walker"] >= 3)
        _check_no_contact(scene)


def test_all_stand_on_the_ground(street, crossing):
    for scene in (street.simulator.scene, crossing.simulator.scene):
        for actor in scene.actors:
            for time in (0.0, 6.0, 12.0):
                vertices = np.concatenate([_vertices_at(b, time) for b in actor.bodies])
                feet = vertices[vertices[:, 2] < vertices[:, 2].min() + 0.15]
                gap = vertices[:, 2].min() - scene.ground.height(feet[:, :2]).mean()
                assert -0.2 < gap < 0.2, (actor.name, time, gap)


def test_ego_vehicles_drive_as_the_presets_say(street, crossing, highway):
    def speed_and_turn(sequence):
        T = np.stack([sequence.T_world_lidar(frame) for frame in range(160)])
        yaw = np.unwrap(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
        speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) / 0.1
        return speed, np.degrees(np.diff(yaw)) / 0.1

    speed, turn = speed_and_turn(street)
    assert speed.min() > 6 and speed.max() < 10
    assert (np.abs(turn) >= 10).sum() >= 10
    assert 1 < np.abs(turn[KEY - 5 : KEY + 5]).mean() < 6
    assert np.abs(speed_and_turn(crossing)).max() == 0.0
    np.testing.assert_allclose(speed_and_turn(highway)[0], 25.0, atol=0.1)
    bodies = highway.simulator.bodies
    velocity = (bodies.T_world_body[121] - bodies.T_world_body[119])[1:, :3, 3] / 0.2
    ahead = velocity @ bodies.T_world_lidar[120][:3, 0]
    assert np.any(np.abs(ahead + 30) < 1.0)


def test_truck_is_16_m_long_and_its_trailer_follows_without_slip(street):
    scene = street.simulator.scene
    actor = next(a for a in scene.actors if a.name == "truck")
    tractor, trailer = actor.bodies
    times = np.arange(0.0, 16.0, 0.05)
    front, back = (b.trajectory.poses(times) for b in actor.bodies)
    nose = front.apply(np.tile([tractor.mesh.bounds[1][0], 0, 0], (len(times), 1)))
    tail = back.apply(np.tile([trailer.mesh.bounds[0][0], 0, 0], (len(times), 1)))
    assert abs(np.linalg.norm(nose - tail, axis=1)[0] - 16) < 0.5
    bent = np.degrees(np.arccos((front.rotation[:, :, 0] * back.rotation[:, :, 0]).sum(1)))
    assert bent.max() > 20
    axle = back.apply(np.tile([-WHEELBASE_M["trailer"] / 2, 0, 0], (len(times), 1)))
    slip = np.einsum("ni,ni->n", np.gradient(axle, 0.05, axis=0), back.rotation[:, :, 1])
    assert np.abs(slip[2:-2]).max() < 0.05


# specifications


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda _: Street.from_spec("street:vilage"), "street, static, crossing, highway"),
        (lambda _: Street.from_spec("street?sensor=hdl65"), "hdl64, hdl32, vlp16, dual32"),
        (lambda _: Street.from_spec("street?sede=7"), "seed, sensor, hz, tilt"),
        (lambda _: Street.from_spec("street?hz=15"), "5, 10, 20"),
        (lambda _: Street.from_spec("street?tilt=nan"), "-45 to 45"),
        (lambda _: Street.from_spec("street?seed=-1"), "whole number"),
        (lambda _: Street.from_spec("road"), "street"),
        (lambda street: street[160], "no frame 160; there are frames 0 to 159"),
        (lambda street: street.T_world_lidar(-1), "no frame -1"),
        (lambda street: street.truth.displacement(KEY, 160), "frames 0 to 159"),
        (lambda street: street.image("image_00", KEY), "image_02, image_03"),
    ],
)
def test_what_does_not_exist_is_named_in_one_line(street, call, words):
    with refusal(words):
        call(street)
