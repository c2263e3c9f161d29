# SPDX-License-Identifier: MIT
"""Mistakes that recordings often have, made on purpose in a good one.

A fault is a view of the good recording; nothing is copied or written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config import Config
from densify.config.errors import InputError
from densify.doctor.paths import scaled, with_rotation
from densify.geometry import poses
from densify.geometry.types import Camera, Float, LidarSequence, Sweep
from densify.registration.deskew import deskew
from densify.registration.trajectory import find_trajectory

_BODY_CAM = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class Faulty:
    """A recording with one mistake: members as in `LidarSequence`, each passed
    through a change if one is given."""

    def __init__(
        self,
        sequence: LidarSequence,
        sweep: Callable[[Sweep], Sweep] | None = None,
        stamp_ns: Callable[[int, int], int] | None = None,
        pose: Callable[[Float], Float] | None = None,
        camera: Callable[[Camera], Camera] | None = None,
        image: Callable[[Any], Any] | None = None,
        image_stamps_ns: Callable[[Mapping[int, int]], Mapping[int, int]] | None = None,
        frames: Sequence[int] | None = None,
        unreadable: Sequence[int] = (),
    ) -> None:
        self.name = sequence.name
        self.truth = None
        self.frames = sequence.frames if frames is None else frames
        self.cameras = {name: camera(c) if camera else c for name, c in sequence.cameras.items()}
        self._sequence, self._sweep, self._stamp_ns, self._pose = sequence, sweep, stamp_ns, pose
        self._image, self._image_stamps_ns, self._unreadable = image, image_stamps_ns, unreadable

    def __getitem__(self, frame: int) -> Sweep:
        if frame in self._unreadable:
            raise InputError(f"{frame:010d}.bin: truncated; fetch the file again")
        sweep = replace(self._sequence[frame], stamp_ns=self.stamp_ns(frame))
        return self._sweep(sweep) if self._sweep else sweep

    def stamp_ns(self, frame: int) -> int:
        stamp_ns = self._sequence.stamp_ns(frame)
        return self._stamp_ns(frame, stamp_ns) if self._stamp_ns else stamp_ns

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        stamps_ns = self._sequence.image_stamps_ns(camera)
        return self._image_stamps_ns(stamps_ns) if self._image_stamps_ns else stamps_ns

    def image(self, camera: str, number: int) -> Any:
        image = self._sequence.image(camera, number)
        return self._image(image) if self._image else image

    def T_world_lidar(self, frame: int) -> Float:
        T = self._sequence.T_world_lidar(frame)
        return self._pose(T) if self._pose else T


def _points(change: Callable[[Float], Float]) -> Callable[[Sweep], Sweep]:
    return lambda sweep: replace(sweep, points=change(sweep.points))


def _offsets(factor: float) -> Callable[[Sweep], Sweep]:
    def changed(sweep: Sweep) -> Sweep:
        if sweep.offset_ns is None:
            return sweep
        return replace(sweep, offset_ns=np.rint(factor * sweep.offset_ns).astype(np.int64))

    return changed


def _with_T_cam_lidar(change: Callable[[Float], Float]) -> Callable[[Camera], Camera]:
    return lambda camera: replace(camera, T_cam_lidar=change(camera.T_cam_lidar))


def _turned_deg(yaw_deg: float) -> Float:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("y", yaw_deg, degrees=True).as_matrix()
    return T


def _shifted(m: tuple[float, float, float]) -> Callable[[Sweep], Sweep]:
    """Points in a vehicle's frame, taken for the scanner's."""
    return lambda s: replace(s, points=s.points + np.array(m), scanner_origins=None)


def _with_hood(sweep: Sweep) -> Sweep:
    """The own vehicle's front, 3.5 to 4 m ahead, in place of the first returns."""
    rng = np.random.default_rng(0)
    hood = rng.uniform([3.5, -0.8, -0.6], [4.0, 0.8, -0.5], (600, 3))
    points = sweep.points.copy()
    points[: len(hood)] = hood
    return replace(sweep, points=points)


def _half(sweep: Sweep) -> Sweep:
    if sweep.frame % 2:
        return sweep
    return sweep.select(np.arange(len(sweep)) < 0.3 * len(sweep))


def _compensated(sequence: LidarSequence, config: Config) -> Faulty:
    """Every sweep as at its reference time, the points' times kept."""

    def at_reference(sweep: Sweep) -> Sweep:
        frames = list(sequence.frames)
        row = min(max(frames.index(sweep.frame), 1), len(frames) - 2)
        around = [sequence[f] for f in frames[row - 1 : row + 2]]
        straight = deskew(around, find_trajectory(around, config.register))
        return straight[sweep.frame].sweep

    return Faulty(sequence, sweep=at_reference)


@dataclass(frozen=True)
class Fault:
    """name: what is wrong. named_by: the checks of which one must find it. make: the recording
    with it, None where it cannot be made of this one."""

    name: str
    named_by: tuple[str, ...]
    make: Callable[[LidarSequence, Config], LidarSequence]


def _fault(name: str, named_by: str, **changes: Any) -> Fault:
    return Fault(name, tuple(named_by.split(", ")), lambda s, _: Faulty(s, **changes))


def _without_middle(sequence: LidarSequence, _: Config) -> LidarSequence:
    frames, third = list(sequence.frames), len(sequence.frames) // 3
    return Faulty(sequence, frames=frames[:third] + frames[2 * third :])


def _broken_file(sequence: LidarSequence, _: Config) -> LidarSequence:
    return Faulty(sequence, unreadable=[sequence.frames[-1]])


def _backward(sequence: LidarSequence, _: Config) -> LidarSequence:
    first, last = (sequence.stamp_ns(sequence.frames[row]) for row in (0, -1))
    return Faulty(sequence, stamp_ns=lambda _, ns: first + last - ns)


def _twice(sequence: LidarSequence, _: Config) -> LidarSequence:
    a, b = sequence.frames[1:3]
    return Faulty(sequence, stamp_ns=lambda f, ns: sequence.stamp_ns(a) if f == b else ns)


FAULTS: tuple[Fault, ...] = (
    _fault("poses inverted", "poses", pose=poses.inverse),
    _fault("poses of a camera", "poses", pose=lambda T: poses.inverse(_BODY_CAM) @ T @ _BODY_CAM),
    _fault("poses in millimetres", "poses", pose=scaled(1e3)),
    _fault(
        "quaternions in another order",
        "poses",
        pose=with_rotation(
            lambda R: Rotation.from_quat(np.roll(Rotation.from_matrix(R).as_quat(), 1)).as_matrix()
        ),
    ),
    _fault("rotations transposed", "poses", pose=with_rotation(np.transpose)),
    _fault("points in millimetres", "unit of points", sweep=_points(lambda p: 1e3 * p)),
    _fault("points in a camera's axes", "axes", sweep=_points(lambda p: p @ _BODY_CAM[:3, :3])),
    _fault("points with z down", "axes", sweep=_points(lambda p: p * [1.0, -1.0, -1.0])),
    _fault(
        "points in the vehicle's frame, scanner's place not given",
        "scanner's place",
        sweep=_shifted((0.9, 0.0, 1.7)),
    ),
    _fault(
        "stamps in microseconds taken for nanoseconds", "stamps", stamp_ns=lambda _, ns: ns // 1000
    ),
    Fault("stamps in reverse", ("stamps",), _backward),
    Fault("one stamp twice", ("stamps",), _twice),
    Fault("a third of the sweeps missing in the middle", ("holes in time",), _without_middle),
    _fault(
        "point times in microseconds taken for nanoseconds", "point times", sweep=_offsets(1e-3)
    ),
    _fault("point times with the wrong sign", "deskewing", sweep=_offsets(-1.0)),
    Fault("compensated already, times kept", ("motion compensation",), _compensated),
    _fault(
        "no point times, sweeps as fired",
        "motion compensation",
        sweep=lambda s: replace(s, offset_ns=None),
    ),
    _fault(
        "reflectance from 0 to 255",
        "intensity",
        sweep=lambda s: replace(s, intensity=255 * s.intensity),
    ),
    _fault("the own vehicle's front 4 m ahead", "own vehicle", sweep=_with_hood),
    _fault("every second sweep broken off", "scanner 0", sweep=_half),
    Fault("a file truncated", ("reading",), _broken_file),
    _fault(
        "T_lidar_cam given as T_cam_lidar", "calibration", camera=_with_T_cam_lidar(poses.inverse)
    ),
    _fault(
        "T_cam_lidar without the camera's axes",
        "calibration",
        camera=_with_T_cam_lidar(lambda T: _BODY_CAM @ T),
    ),
    _fault(
        "camera turned by 1.5 degrees",
        "calibration",
        camera=_with_T_cam_lidar(lambda T: _turned_deg(1.5) @ T),
    ),
    _fault(
        "K of images twice as large",
        "calibration",
        camera=lambda c: replace(c, K=np.diag([2.0, 2.0, 1.0]) @ c.K),
    ),
    _fault(
        "camera's clock 80 ms late",
        "clock, calibration",
        image_stamps_ns=lambda s: {n: ns + 80_000_000 for n, ns in s.items()},
    ),
    _fault(
        "camera's clock an hour off",
        "images",
        image_stamps_ns=lambda s: {n: ns + 3600 * 10**9 for n, ns in s.items()},
    ),
    _fault(
        "images of every third sweep only",
        "images",
        image_stamps_ns=lambda s: dict(list(s.items())[: len(s) // 3]),
    ),
    _fault("images black", "calibration", image=lambda image: np.zeros_like(image)),
)
