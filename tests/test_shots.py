# SPDX-License-Identifier: MIT
"""Which images a key shows, each at its own time, each row at its own."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from densify.config import ProjectSettings
from densify.config.errors import InputError
from densify.depth.exposure import Exposure, key_shots
from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.pipeline.run import compare, run
from densify.readers.street import Street
from tests.scenes import CAMERA, SWEEP_S, TinySequence, by_flow, stamp_ns
from tests.small_street import KEY, POSES_GIVEN, one_car

SWEEP = ProjectSettings()
IMAGE = ProjectSettings(per="image")
MS = 1_000_000


class OtherClock(TinySequence):
    """Images by number -> milliseconds after the first sweep."""

    def __init__(self, images_ms, frames=range(11), **options):
        super().__init__(one_car().scene, frames, **options)
        self.images_ms = images_ms

    def image_stamps_ns(self, camera):
        return {n: stamp_ns(0) + round(ms * MS) for n, ms in self.images_ms.items()}

    def image(self, camera, number):
        assert number in self.images_ms
        return np.full((CAMERA.height_px, CAMERA.width_px, 3), number, np.uint8)


def chosen(images_ms, key, settings=SWEEP, frames=range(11)):
    sequence = OtherClock(images_ms, frames)
    shots = key_shots(sequence, list(sequence.cameras.values()), key, settings)
    return {name: shot.number for name, shot in shots.items()}


TEN_HZ, FIVE_HZ = range(11), range(0, 11, 2)
HOLE = (0, 1, 2, 3, 4, 9, 10)


@pytest.mark.parametrize(
    ("images_ms", "key", "number", "frames"),
    [
        ({n: 7 + n * 33.3 for n in range(31)}, 5, 15, TEN_HZ),
        ({0: 560, 1: 541, 2: 549}, 5, 1, TEN_HZ),
        ({0: 450, 7: 550}, 5, 7, TEN_HZ),  # between two sweeps: the earlier's
        ({3: 497, 4: 503}, 5, 3, TEN_HZ),  # of two equally near ones the earlier
        ({4: 400, 6: 600}, 5, None, TEN_HZ),
        # at a hole in the sweeps an image half a period off is no key's, nor at the end
        ({4: 480}, 4, None, HOLE),
        ({4: 470}, 4, 4, HOLE),
        ({4: 1090}, 10, None, TEN_HZ),
        ({4: 490}, 4, 4, FIVE_HZ),  # every second sweep of a drive: one of 5 Hz
        ({1: 5000}, 3, 1, [3]),  # the only sweep there is
    ],
)
def test_a_key_takes_the_image_exposed_nearest(images_ms, key, number, frames):
    assert chosen(images_ms, key, frames=frames) == {"front": number}


def test_a_key_without_an_image_has_no_map_per_image(caplog):
    with caplog.at_level(logging.WARNING, "densify"):
        assert chosen({4: 400, 6: 600}, 5, IMAGE) == {}
    assert "key 5: tiny has no image of front within 50 ms of the sweep: no depth" in caplog.text


def test_every_image_is_one_keys():
    rng = np.random.default_rng(0)
    images = dict(enumerate(np.sort(rng.uniform(-40, 1040, 60)).tolist())) | {60: 1050}
    found = [chosen(images, key, IMAGE) for key in range(11)]
    numbers = [n for shots in found for n in shots.values()]
    assert sorted(numbers) == sorted(images)
    assert all(name == f"front/{n:06d}" for shots in found for name, n in shots.items())
    for key, shots in enumerate(found):
        assert all(abs(images[n] - 100 * key) <= 50 for n in shots.values())


def test_the_moment_of_the_sweep_shows_no_image_for_itself():
    with pytest.raises(InputError, match=r"project\.per=image: .* got project.at=sweep"):
        ProjectSettings(per="image", at="sweep")
    sequence = OtherClock({5: 520})
    shot = key_shots(sequence, [CAMERA], 5, ProjectSettings(at="sweep"))["front"]
    assert (shot.number, shot.stamp_ns) == (5, stamp_ns(5))


def test_without_its_image_a_key_has_depth_but_no_colour():
    config = POSES_GIVEN
    whole = run(one_car(), KEY, 1, "icp", config=config)
    lost = OtherClock({n: 100 * n for n in range(7) if n != KEY}, range(7))
    result = run(lost, KEY, 1, "icp", config=config)
    said = "front: no image belongs to the sweep, the nearest was taken 0.1 s away"
    assert f"{said}: its map has no colour" in result.warnings
    assert result.depth["front"].depth_m.tobytes() == whole.depth["front"].depth_m.tobytes()
    assert not result.cloud.rgb.any() and whole.cloud.rgb.any()
    assert result.images == {} and "depth" not in result.metrics


def test_maps_between_two_sweeps_are_the_streets():
    sequence = OtherClock({n: 100 * n + 5 + k * 30 for k in range(3) for n in [KEY * 3 + k]})
    sequence.images_ms = {30 + k: 100 * KEY - 30 + 30 * k for k in range(3)}
    config = POSES_GIVEN | {"project": {"per": "image"}}
    result = by_flow(sequence, KEY, 2, config=config)
    assert list(result.depth) == [f"front/{n:06d}" for n in (30, 31, 32)]
    assert [im[0, 0, 0] for im in result.images.values()] == [30, 31, 32]
    assert set(result.metrics["density"]) == set(result.depth)
    for late_s, maps in zip((-0.03, 0.0, 0.03), result.depth.values(), strict=True):
        truth = one_car(late_s=late_s).truth
        true_m, moving = truth.depth_m("front", KEY), truth.moving_mask("front", KEY)
        both = (maps.depth_m > 0) & (true_m > 0)
        off_m = np.abs(maps.depth_m - true_m)
        assert (off_m[both] > 0.05 * true_m[both]).mean() < 0.02
        assert np.median(off_m[both & moving]) < 0.1  # 4 m/s apart: 0.12 m in 30 ms
        since_s = np.abs((maps.frame[both] - KEY) * SWEEP_S - late_s)
        np.testing.assert_allclose(maps.age_s[both], since_s, atol=1e-6)


AHEAD = poses.exp(np.array([0, 0, 0, 0.5, 0, 0]))


class PosedImages(TinySequence):
    """Whose images were taken 0.5 m ahead of where the vehicle is."""

    def T_world_cam(self, camera, number):
        T_world_lidar = self.scene.T_world_lidar(number * SWEEP_S + self.late_s)
        return T_world_lidar @ AHEAD @ poses.inverse(CAMERA.T_cam_lidar)


def test_the_data_sets_own_pose_of_an_image_is_taken():
    plain = one_car(late_s=0.02)
    sequence = PosedImages(plain.scene, plain.frames, 0.02)
    found = run(sequence, KEY, 1, "icp", config=POSES_GIVEN).depth["front"].depth_m
    moved = replace(CAMERA, T_cam_lidar=CAMERA.T_cam_lidar @ poses.inverse(AHEAD))
    other = TinySequence(plain.scene, plain.frames, 0.02, cameras=(moved,))
    expected = run(other, KEY, 1, "icp", config=POSES_GIVEN).depth["front"].depth_m
    both = (found > 0) & (expected > 0)
    assert both.sum() > 5000 and (np.abs(found - expected)[both] < 0.02).mean() > 0.95
    usual = run(plain, KEY, 1, "icp", config=POSES_GIVEN).depth["front"].depth_m
    assert (np.abs(found - usual)[(found > 0) & (usual > 0)] < 0.02).mean() < 0.5


# --- rolling shutter ------------------------------------------------------------------------------

ROLLING = replace(
    CAMERA, width_px=960, height_px=320, K=np.array([[600.0, 0, 480], [0, 600, 140], [0, 0, 1]])
)
TWIST = np.array([0.1, 0.5, -0.2, 1.0, -0.5, 12.0])


def seen_row_by_row(exposure, point, velocity):
    """A slow twin: where a point is seen in the row or column that is exposed when it is there."""
    camera = exposure.camera
    axis = 0 if camera.column_time_s else 1
    middle = ((camera.width_px, camera.height_px)[axis] - 1) / 2

    def off(v):
        late_s = (v - middle) * (camera.row_time_s or camera.column_time_s)
        now = point + (exposure.late_s + late_s) * velocity
        p = poses.transform(exposure.T_cam_key, now[None])
        camera_moved = poses.exp(late_s * exposure.twist)
        p = poses.transform(poses.inverse(camera_moved), p)
        uv, inside = image_points(exposure.camera, p)
        return uv[0], inside[0], p[0]

    low, high = 0.0, 2 * middle
    for _ in range(40):
        v = (low + high) / 2
        low, high = (v, high) if off(v)[0][axis] > v else (low, v)
    return off((low + high) / 2)


@pytest.mark.parametrize(("axis", "time_s"), [("row", 1e-4), ("column", -1e-4)])
def test_points_are_seen_when_their_row_or_column_is_exposed(axis, time_s):
    size = ROLLING.height_px if axis == "row" else ROLLING.width_px
    camera = replace(ROLLING, **{f"{axis}_time_s": time_s})
    assert camera.is_rolling and camera.readout_s == pytest.approx(size * 1e-4)
    exposure = Exposure(camera, CAMERA.T_cam_lidar, late_s=0.02, twist=TWIST)
    rng = np.random.default_rng(1)
    points = rng.uniform([6, -9, -2], [40, 9, 3], (200, 3))
    velocity = rng.normal(0, 6, (200, 3))
    sight = exposure.see(points, velocity)
    assert sight.inside.sum() > 80
    still = replace(exposure, camera=ROLLING).see(points, velocity)
    moved = np.linalg.norm(sight.uv - still.uv, axis=1)[sight.inside]
    assert np.quantile(moved, 0.75) > 1.5
    for i in np.flatnonzero(sight.inside)[:40]:
        uv, inside, p = seen_row_by_row(exposure, points[i], velocity[i])
        assert inside
        np.testing.assert_allclose(sight.uv[i], uv, atol=0.03)
        np.testing.assert_allclose(sight.points_cam[i], p, atol=1e-3)
    along = sight.uv[:, 1 if axis == "row" else 0]
    middle = np.abs(along - (size - 1) / 2) < 0.5
    np.testing.assert_allclose(sight.uv[middle], still.uv[middle], atol=0.5)


def test_a_fisheye_of_190_degrees_measures_the_street():
    street, key = Street.from_spec("street:static?cameras=fisheye&sensor=hdl32"), 60
    method = "icp-visible"
    result = compare(street, key, 1, None, POSES_GIVEN, methods=(method,))[method]
    maps = result.depth["fisheye"]
    near = key_shots(street, [street.cameras["fisheye"]], key, SWEEP)["fisheye"]
    true_m = street.truth.depth_m("fisheye", near.number)
    known = (maps.depth_m > 0) & (true_m > 0)
    off_m = np.abs(maps.depth_m - true_m)[known]
    assert known.mean() > 0.05
    assert (off_m > 0.05 * maps.depth_m[known]).mean() < 0.01
    assert result.metrics["measure"] == {"fisheye": "range"}
    v, u = np.nonzero(known)
    rim = np.hypot(u - 199.5, v - 199.5) > 188  # beyond 90 degrees
    assert rim.sum() > 20 and np.median(off_m[rim]) < 0.1
    assert result.cloud.rgb.any()
