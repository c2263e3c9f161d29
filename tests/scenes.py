# SPDX-License-Identifier: MIT
"""A tiny analytic street for tests: boxes on sloping ground with kerbs, seen by a spinning scanner
whose every ray leaves at its own time from a lidar that drives and turns. Numpy only, exact truth.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from densify.config import Config
from densify.geometry import poses
from densify.geometry.types import (
    Camera,
    LidarSequence,
    Result,
    Stretch,
    Sweep,
    SweepTruth,
    Trajectory,
)
from densify.pipeline.run import compare
from densify.registration.deskew import deskew

SWEEP_S = 0.1
EPOCH_NS = 1_317_000_000_000_000_789  # stamps of 19 digits, as real ones are
KERB_Y_M, KERB_M = 4.0, 0.12
LIDAR_HEIGHT_M = 1.73
GROUND, NOTHING = -1, -2  # what a ray met, if no box


@dataclass(frozen=True)
class Arc:
    """Constant speed and turn rate in the plane, from (x, y, yaw) at time 0."""

    x: float
    y: float
    yaw: float = 0.0
    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0

    def at(self, time_s) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        t = np.asarray(time_s, float)
        half = 0.5 * self.turn_rad_s * t
        chord = self.speed_m_s * t * np.sinc(half / np.pi)
        return (
            self.x + chord * np.cos(self.yaw + half),
            self.y + chord * np.sin(self.yaw + half),
            self.yaw + 2 * half,
        )


@dataclass(frozen=True)
class Box:
    """Length, width, height (m), upright on the ground, ``base_m`` above it.

    instance: -1 for what stands still. solid: share of the rays it stops; the others and those
    stopped somewhere inside make it foliage.
    """

    size_m: tuple[float, float, float]
    path: Arc
    base_m: float = 0.0
    instance: int = -1
    solid: float = 1.0


@dataclass(frozen=True)
class World:
    boxes: tuple[Box, ...]
    slope: float = 0.0

    def ground_m(self, x, y):
        return self.slope * x + np.where(np.abs(y) > KERB_Y_M, KERB_M, 0.0)

    def cast(self, origin, direction, time_s, rng) -> tuple[np.ndarray, np.ndarray]:
        """Columns of rays: origin (C,3), direction (C,B,3) of one azimuth each, time_s (C,)
        -> range in directions' lengths (C,B), inf if nothing, and index of the box (C,B)."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            range_m = self._ground_range(origin[:, None], direction)
            met = np.where(np.isfinite(range_m), GROUND, NOTHING)
            azimuth = np.arctan2(direction[:, 0, 1], direction[:, 0, 0])
            for index, box in enumerate(self.boxes):
                columns, near, far = self._box_range(box, origin, direction, time_s, azimuth)
                if box.solid < 1:
                    near = near + (far - near) * rng.random(near.shape)
                    near = np.where(rng.random(near.shape) < box.solid, near, np.inf)
                closer = near < range_m[columns]
                range_m[columns] = np.where(closer, near, range_m[columns])
                met[columns] = np.where(closer, index, met[columns])
        return range_m, met

    def _ground_range(self, origin, direction):
        o, d = np.moveaxis(origin, -1, 0), np.moveaxis(direction, -1, 0)
        nearest = np.full(direction.shape[:2], np.inf)

        def offer(t, allowed):
            nearest[...] = np.where((t > 0) & allowed & (t < nearest), t, nearest)

        for height_m, outside in ((0.0, False), (KERB_M, True)):
            t = (self.slope * o[0] + height_m - o[2]) / (d[2] - self.slope * d[0])
            offer(t, (np.abs(o[1] + t * d[1]) > KERB_Y_M) == outside)
        for y in (-KERB_Y_M, KERB_Y_M):
            t = (y - o[1]) / d[1]
            up = o[2] + t * d[2] - self.slope * (o[0] + t * d[0])
            offer(t, (up > 0) & (up < KERB_M))
        return nearest

    def _box_range(self, box, origin, direction, time_s, azimuth):
        """(columns that may meet it, range of entry, range of exit), inf where they miss."""
        x, y, yaw = box.path.at(time_s)
        dx, dy = x - origin[:, 0], y - origin[:, 1]
        distance, radius = np.hypot(dx, dy), 0.5 * np.hypot(*box.size_m[:2])
        off = np.abs((azimuth - np.arctan2(dy, dx) + np.pi) % (2 * np.pi) - np.pi)
        half = np.where(distance > radius, np.arcsin(np.minimum(radius / distance, 1)), np.pi)
        columns = np.flatnonzero(off <= half)
        c, s = np.cos(yaw[columns])[:, None], np.sin(yaw[columns])[:, None]
        low = self.ground_m(x, y)[columns] + box.base_m + 0.5 * box.size_m[2]
        to = np.stack([-dx[columns], -dy[columns], origin[columns, 2] - low], -1)[:, None]
        d = direction[columns]
        near, far = np.zeros(d.shape[:2]), np.full(d.shape[:2], np.inf)
        turned = [
            (c * v[..., 0] + s * v[..., 1], c * v[..., 1] - s * v[..., 0], v[..., 2])
            for v in (to, d)
        ]
        for o, along, length in zip(*turned, box.size_m, strict=True):
            a, b = (-0.5 * length - o) / along, (0.5 * length - o) / along
            near, far = np.maximum(near, np.fmin(a, b)), np.minimum(far, np.fmax(a, b))
        hit = (near <= far) & (near > 0)
        return columns, np.where(hit, near, np.inf), np.where(hit, far, np.inf)


@dataclass(frozen=True)
class Scanner:
    num_beams: int = 64
    num_azimuths: int = 900
    elevation_deg: tuple[float, float] = (-24.8, 2.0)
    sigma_m: float = 0.0
    max_range_m: float = 80.0


@dataclass(frozen=True)
class Scan:
    """A raw sweep and, row by row, the world points that were hit and the box (or GROUND)."""

    sweep: Sweep
    world: np.ndarray
    box: np.ndarray
    instance: np.ndarray


@dataclass(frozen=True)
class Scene:
    """Frames 0, 1, 2, …: frame f's reference time is f · 0.1 s."""

    world: World
    ego: Arc = Arc(0.0, -1.5)
    scanner: Scanner = Scanner()
    seed: int = 0

    def T_world_lidar(self, time_s: float) -> np.ndarray:
        x, y, yaw = self.ego.at(time_s)
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = x, y, self.world.slope * x + LIDAR_HEIGHT_M
        return T

    def scan(self, frame: int) -> Scan:
        return _scan(self, frame)

    def height_m(self, frame: int) -> np.ndarray:
        """(N,) true height above the ground."""
        p = self.scan(frame).world
        return (p[:, 2] - self.world.ground_m(p[:, 0], p[:, 1])).astype(np.float32)

    def displacement(self, frame: int, target: int) -> np.ndarray:
        """(N,3) of the points as scanned, over the time between the two frames, in the lidar frame
        of ``frame``."""
        scan = self.scan(frame)
        start = frame * SWEEP_S + scan.sweep.offset_ns * 1e-9
        moved = np.zeros_like(scan.world)
        for index, box in enumerate(self.world.boxes):
            on = scan.box == index
            if box.instance >= 0 and on.any():
                x0, y0, yaw0 = box.path.at(start[on])
                x1, y1, yaw1 = box.path.at(start[on] + (target - frame) * SWEEP_S)
                c, s = np.cos(yaw1 - yaw0), np.sin(yaw1 - yaw0)
                p = scan.world[on]
                ax, ay = p[:, 0] - x0, p[:, 1] - y0
                to = np.stack([x1 + c * ax - s * ay, y1 + s * ax + c * ay], -1)
                moved[on, :2] = to - p[:, :2]
                moved[on, 2] = self.world.slope * (x1 - x0)
        return moved @ self.T_world_lidar(frame * SWEEP_S)[:3, :3]

    def trajectory(self, frames: Sequence[int]) -> Trajectory:
        return Trajectory(
            tuple(frames),
            np.array([stamp_ns(f) for f in frames], np.int64),
            np.stack([self.T_world_lidar(f * SWEEP_S) for f in frames]),
        )

    def stretch(self, middle: int, size: int) -> Stretch:
        """``size`` sweeps on each side of the middle one, deskewed and placed by the truth."""
        frames = list(range(middle - size, middle + size + 1))
        sweeps = [self.scan(f).sweep for f in frames]
        return deskew(sweeps, self.trajectory([frames[0] - 1, *frames, frames[-1] + 1]))


@lru_cache(maxsize=64)
def _scan(scene: Scene, frame: int) -> Scan:
    """The same for all scenes that are alike: tests make them anew."""
    s, rng = scene.scanner, np.random.default_rng([scene.seed, frame])
    offset_s = ((np.arange(s.num_azimuths) + 0.5) / s.num_azimuths - 0.5) * SWEEP_S
    azimuth = -2 * np.pi * offset_s / SWEEP_S  # clockwise
    elevation = np.deg2rad(np.linspace(*s.elevation_deg, s.num_beams))
    ray = np.stack(
        np.broadcast_arrays(
            np.cos(azimuth)[:, None] * np.cos(elevation),
            np.sin(azimuth)[:, None] * np.cos(elevation),
            np.sin(elevation),
        ),
        -1,
    )
    x, y, yaw = scene.ego.at(frame * SWEEP_S + offset_s)
    origin = np.stack([x, y, scene.world.slope * x + LIDAR_HEIGHT_M], -1)
    c, sn = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    direction = np.stack(
        [c * ray[..., 0] - sn * ray[..., 1], sn * ray[..., 0] + c * ray[..., 1], ray[..., 2]],
        -1,
    )
    range_m, met = scene.world.cast(origin, direction, frame * SWEEP_S + offset_s, rng)
    keep = range_m < s.max_range_m
    measured = range_m + s.sigma_m * rng.standard_normal(range_m.shape)
    offset_ns = np.rint(offset_s * 1e9).astype(np.int64)[:, None]
    n, box = int(keep.sum()), met[keep]
    instances = np.array([b.instance for b in scene.world.boxes] + [-1, -1], np.int32)
    sweep = Sweep(
        frame=frame,
        stamp_ns=stamp_ns(frame),
        points=(ray * measured[..., None])[keep],
        intensity=(0.1 + 0.8 * (box % 7) / 7).astype(np.float32),
        offset_ns=np.broadcast_to(offset_ns, keep.shape)[keep].copy(),
        lidar=np.zeros(n, np.uint8),
        row=np.arange(n),
    )
    world = (origin[:, None] + direction * measured[..., None])[keep]
    return Scan(sweep, world, box, instances[box])


def stamp_ns(frame: int) -> int:
    return EPOCH_NS + frame * round(SWEEP_S * 1e9)


def street(length_m: float = 90.0) -> tuple[Box, ...]:
    """Houses set back by different lengths on both sides of the road, closed off at the far end,
    and on the pavement enough poles, planters and parked cars for odometry to hold on to."""
    rng = np.random.default_rng(7)
    boxes = [Box((6.0, 30.0, 5.0), Arc(0.7 * length_m, 0.0, 0.3))]
    for side in (-1, 1):
        for x in np.arange(-0.4 * length_m, 0.7 * length_m, 9.0):
            depth, width = rng.uniform(4, 7), rng.uniform(4, 7)
            y = side * (8.5 + rng.uniform(0, 3) + depth / 2)
            boxes.append(Box((width, depth, rng.uniform(3, 7)), Arc(x, y, rng.normal(0, 0.15))))
        for x in np.arange(-0.4 * length_m, 0.6 * length_m, 3.0):
            at = Arc(x + rng.uniform(-1, 1), side * rng.uniform(5.0, 7.5), rng.uniform(0, 1))
            kinds = [(0.3, 0.3, 5.0), (0.8, 0.6, 1.0), (1.5, 1.0, 2.2), (4.2, 1.8, 1.5)]
            boxes.append(Box(kinds[rng.integers(4)], at))
    return tuple(boxes)


ROOM = tuple(
    Box((size_x, size_y, 40.0), Arc(x, y))
    for x, y, size_x, size_y in ((21, 0, 2, 44), (-21, 0, 2, 44), (0, 21, 44, 2), (0, -21, 44, 2))
)  # four walls 20 m away


def car(x, y, speed_m_s, instance, yaw=0.0, turn_rad_s=0.0, size_m=(4.2, 1.8, 1.4)) -> Box:
    return Box(size_m, Arc(x, y, yaw, speed_m_s, turn_rad_s), 0.15, instance)


CAMERA = Camera(
    name="front",
    width_px=240,
    height_px=80,
    K=np.array([[150.0, 0, 119.5], [0, 150.0, 34.5], [0, 0, 1]]),
    T_cam_lidar=np.array([[0, -1, 0, 0], [0, 0, -1, -0.1], [1, 0, 0, -0.2], [0, 0, 0, 1.0]]),
)


def on_sphere(azimuth_deg, elevation_deg, range_m) -> np.ndarray:
    """(N,3) points in these directions."""
    a, e, r = np.broadcast_arrays(np.deg2rad(azimuth_deg), np.deg2rad(elevation_deg), range_m)
    return np.stack([r * np.cos(a) * np.cos(e), r * np.sin(a) * np.cos(e), r * np.sin(e)], -1)


def by_flow(
    sequence: LidarSequence,
    key: int,
    window: int,
    cameras: Sequence[str] | None = None,
    config: Mapping[str, object] | Config | None = None,
) -> Result:
    """As `densify.run`, without its baselines: their maps take twice the time of its own."""
    return compare(sequence, key, window, cameras, config, methods=("flow",))["flow"]


class TinySequence:
    """A scene as a recording. ``late_s``: the camera's shutter after the sweep's reference time."""

    def __init__(
        self,
        scene: Scene,
        frames: Iterable[int] = range(11),
        late_s: float = 0.0,
        cameras: Sequence[Camera] = (CAMERA,),
        with_truth: bool = True,
    ) -> None:
        self.name = "tiny"
        self.scene = scene
        self.frames: Sequence[int] = tuple(frames)
        self.cameras: Mapping[str, Camera] = {c.name: c for c in cameras}
        self.late_s = late_s
        self.truth = TinyTruth(self) if with_truth else None
        self.read: list[int] = []

    def __getitem__(self, frame: int) -> Sweep:
        self.read.append(frame)
        return self.scene.scan(frame).sweep

    def stamp_ns(self, frame: int) -> int:
        return stamp_ns(frame)

    def image(self, camera: str, frame: int) -> np.ndarray:
        return np.full((CAMERA.height_px, CAMERA.width_px, 3), 128, np.uint8)

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        return {frame: stamp_ns(frame) + round(self.late_s * 1e9) for frame in self.frames}

    def T_world_lidar(self, frame: int) -> np.ndarray:
        return self.scene.T_world_lidar(frame * SWEEP_S)


@dataclass(frozen=True)
class TinyTruth:
    sequence: TinySequence
    _seen: dict[tuple[str, int, float], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    def sweep(self, frame: int) -> SweepTruth:
        scan = self.sequence.scene.scan(frame)
        T = self.sequence.T_world_lidar(frame)
        points = poses.transform(poses.inverse(T), scan.world)
        return SweepTruth(T, points, scan.instance, scan.instance >= 0)

    def displacement(self, frame: int, target: int) -> np.ndarray:
        return self.sequence.scene.displacement(frame, target)

    def depth_m(self, camera: str, frame: int) -> np.ndarray:
        return self._view(camera, frame)[0]

    def moving_mask(self, camera: str, frame: int) -> np.ndarray:
        return self._view(camera, frame)[1]

    def _view(self, name: str, frame: int) -> tuple[np.ndarray, np.ndarray]:
        moment = name, frame, self.sequence.late_s
        if moment in self._seen:
            return self._seen[moment]
        camera, scene = self.sequence.cameras[name], self.sequence.scene
        time_s = frame * SWEEP_S + self.sequence.late_s
        T_world_cam = scene.T_world_lidar(time_s) @ poses.inverse(camera.T_cam_lidar)
        u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px), indexing="ij")
        ray = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T  # z is 1
        solid = World(tuple(replace(b, solid=1.0) for b in scene.world.boxes), scene.world.slope)
        depth, met = solid.cast(
            np.tile(T_world_cam[:3, 3], (camera.width_px, 1)),
            ray @ T_world_cam[:3, :3].T,
            np.full(camera.width_px, time_s),
            np.random.default_rng(0),
        )
        instances = np.array([b.instance for b in scene.world.boxes] + [-1, -1])
        near = np.where(depth < 80, depth, 0).astype(np.float32)
        self._seen[moment] = near.T.copy(), (instances[met] >= 0).T.copy()
        return self._seen[moment]
