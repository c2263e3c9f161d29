# SPDX-License-Identifier: MIT
"""Frames of a street, their truth, and boxes as a person would draw them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from densify.geometry import poses
from densify.geometry.types import Bool, Float, Int
from densify.outputs import simulated_street
from densify.readers.street import write_bodies, write_depth, write_points
from densify.street.lidar import Returns

put = simulated_street.put
_MIN_RETURNS = 5


class Excerpt(simulated_street.Excerpt):
    def returns(self, frame: int) -> Returns:
        return self.street.returns(frame)

    def fired(self, frame: int) -> Float:
        """(N,3) points as fired, in the scanner's frame."""
        return self.street.returns(frame).points.astype(np.float64)

    def pose(self, stamp_ns: int, T_lidar_ego: Float | None = None) -> Float:
        """(4,4) of the scanner, or of a frame fixed to it."""
        return self.T_world_ego(np.array([stamp_ns]), T_lidar_ego)[0]

    def jpeg_image(self, camera: str, number: int) -> bytes:
        bgr = np.ascontiguousarray(self.street.image(camera, number)[:, :, ::-1])
        return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    def rings(self, frame: int) -> Int:
        """(N,) the beam of its spinning scanner that measured each return, from the lowest."""
        returns = self.returns(frame)
        ring = np.zeros(len(returns.points), np.int64)
        for number, scanner in enumerate(self.street.simulator.sensor.scanners):
            rows = np.flatnonzero(returns.lidar == number)
            x, y, z = (returns.points[rows] - np.array(scanner.origin_m)).T
            beams_deg = np.sort(scanner.pattern.elevation_deg)
            between_deg = (beams_deg[1:] + beams_deg[:-1]) / 2
            elevation_deg = np.degrees(np.arctan2(z, np.hypot(x, y)))
            ring[rows] = np.searchsorted(between_deg, elevation_deg)
        return ring

    def columns(self, frame: int, num_beams: int) -> tuple[int, Int]:
        """Number of firings of all beams in a turn, and the (N,) firing of each return."""
        period_ns = self.street.simulator.period_ns
        num = self.street.simulator.sensor.scanners[0].pattern.num_pulses(period_ns * 1e-9)
        fired_ns = -period_ns // 2 + np.arange(num, dtype=np.int64) * period_ns // num
        pulse = np.searchsorted(fired_ns, self.returns(frame).offset_ns)
        return num // num_beams, pulse // num_beams

    def write_truth(
        self,
        folder: Path,
        stamp_ns: Sequence[int],
        T_lidar_ego: Float | None = None,
        row_of: Mapping[int, Int] | None = None,
        names: Mapping[str, str] | None = None,
    ) -> None:
        """Truth for a reader that numbers sweeps and images from 0.

        stamp_ns: reference time of each sweep in the format. T_lidar_ego: (4,4) the frame of the
        format's points. row_of: by frame the (N,) rows of the returns in the format's file.
        names: the format's names of the street's cameras.
        """
        simulator, truth = self.street.simulator, self.street.truth
        bodies = simulator.bodies_at(stamp_ns)
        T_world_ego = bodies.T_world_lidar @ (np.eye(4) if T_lidar_ego is None else T_lidar_ego)
        write_bodies(folder, type(bodies)(T_world_ego, bodies.T_world_body, bodies.moving))
        for number, frame in enumerate(self.frames):
            returns = self.returns(frame)
            rows = np.arange(len(returns.points)) if row_of is None else row_of[frame]
            num = int(rows.max(initial=-1)) + 1
            body, instance = np.zeros(num, np.int32), np.full(num, -1, np.int32)
            points = np.zeros((num, 3))
            body[rows], instance[rows] = returns.body, returns.instance
            points[rows] = simulator.in_bodies(frame, returns)
            write_points(folder, number, body, instance, points)
        for camera in self.cameras:
            for number, image in enumerate(self.image_numbers(camera)):
                depth_m, moving = truth.depth_m(camera, image), truth.moving_mask(camera, image)
                write_depth(folder, (names or {}).get(camera, camera), number, depth_m, moving)


def quaternion(T: Float) -> Float:
    """(...,4,4) -> (...,4) w x y z, w not negative."""
    x_y_z_w = Rotation.from_matrix(T[..., :3, :3]).as_quat(canonical=True)
    return x_y_z_w[..., [3, 0, 1, 2]]


@dataclass(frozen=True)
class DrawnBoxes:
    """The K boxes of one sweep. instance: (K,). T_world_box: (K,4,4) at met_ns (K,), when the
    sweep's rays met the object on average. size_m: (K,3). moving: (K,) bool."""

    instance: Int
    T_world_box: Float
    size_m: Float
    met_ns: Int
    moving: Bool


def drawn_boxes(excerpt: Excerpt, frame: int, lidar: int | None = None) -> DrawnBoxes:
    """Boxes of the objects with 5 returns or more. lidar: of that scanner alone."""
    street, returns = excerpt.street, excerpt.returns(frame)
    bodies = street.simulator.scene.world.bodies
    met = np.isin(returns.instance, [b.instance for b in bodies if b.instance >= 0])
    if lidar is not None:
        met &= returns.lidar == lidar
    found, row, times = np.unique(returns.instance[met], return_inverse=True, return_counts=True)
    late_ns = np.rint(np.bincount(row, returns.offset_ns[met]) / times).astype(np.int64)
    seen = times >= _MIN_RETURNS
    instances, met_ns = found[seen].astype(np.int64), street.stamp_ns(frame) + late_ns[seen]
    T_world_box, size_m = np.zeros((len(instances), 4, 4)), np.zeros((len(instances), 3))
    moving = np.zeros(len(instances), bool)
    for k, instance in enumerate(instances):
        parts = [i for i, b in enumerate(bodies) if b.instance == instance]
        then = street.simulator.bodies_at([int(met_ns[k])], parts)
        T_world_main, T_main_box = then.T_world_body[0, 0], np.eye(4)
        T_main_world = poses.inverse(T_world_main)
        corners = np.concatenate(
            [
                poses.transform(T_main_world @ T_world_part, bodies[i].mesh.vertices)
                for i, T_world_part in zip(parts, then.T_world_body[0], strict=True)
            ]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        T_main_box[:3, 3] = (low + high) / 2
        T_world_box[k], size_m[k] = T_world_main @ T_main_box, high - low
        moving[k] = then.moving[0, 0]
    return DrawnBoxes(instances, T_world_box, size_m, met_ns, moving)
