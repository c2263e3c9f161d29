# SPDX-License-Identifier: MIT
"""Mistakes that recordings often have, made on purpose in a good one.

A fault is a view of the good recording; nothing is copied or written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.doctor.motion import change_pose
from densify.geometry import poses
from densify.geometry.types import Float, LidarSequence, Sweep

_BODY_CAM = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


class Faulty:
    """A recording with one mistake: members as in `LidarSequence`, each passed through its change.

    changes: functions of a sweep, a stamp_ns (and its frame before), a pose, a camera, an image, or
    all image_stamps_ns of a camera. unreadable: frames whose sweep cannot be read.
    """

    def __init__(
        self,
        sequence: LidarSequence,
        frames: Sequence[int] | None = None,
        unreadable: Sequence[int] = (),
        **changes: Callable[..., Any] | None,
    ) -> None:
        self.name, self.truth = sequence.name, None
        self.frames = sequence.frames if frames is None else frames
        self._sequence, self._unreadable, self._changes = sequence, unreadable, changes
        self.cameras = {n: self._changed("camera", c) for n, c in sequence.cameras.items()}

    def _changed(self, member: str, *values: Any) -> Any:
        """The last value is the member's own."""
        change = self._changes.get(member)
        return change(*values) if change else values[-1]

    def __getitem__(self, frame: int) -> Sweep:
        if frame in self._unreadable:
            raise InputError(f"{frame:010d}.bin: truncated; fetch the file again")
        sweep = replace(self._sequence[frame], stamp_ns=self.stamp_ns(frame))
        return self._changed("sweep", sweep)

    def stamp_ns(self, frame: int) -> int:
        return self._changed("stamp_ns", frame, self._sequence.stamp_ns(frame))

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        return self._changed("image_stamps_ns", self._sequence.image_stamps_ns(camera))

    def image(self, camera: str, number: int) -> Any:
        return self._changed("image", self._sequence.image(camera, number))

    def T_world_lidar(self, frame: int) -> Float:
        return self._changed("pose", self._sequence.T_world_lidar(frame))


Changes = dict[str, Any]


def _points(change: Callable[[Float], Float]) -> Changes:
    return {"sweep": lambda sweep: replace(sweep, points=change(sweep.points))}


def _T_cam_lidar(change: Callable[[Float], Float]) -> Changes:
    return {"camera": lambda camera: replace(camera, T_cam_lidar=change(camera.T_cam_lidar))}


def _in_the_vehicle(sweep: Sweep) -> Sweep:
    return replace(sweep, points=sweep.points + [0.9, 0.0, 1.7], scanner_origins=None)


def _microseconds(sweep: Sweep) -> Sweep:
    return replace(sweep, offset_ns=np.rint(1e-3 * sweep.offset_ns).astype(np.int64))


def _half(sweep: Sweep) -> Sweep:
    return sweep if sweep.frame % 2 else sweep.select(np.arange(len(sweep)) < 0.3 * len(sweep))


def _hour_off(stamps_ns: Mapping[int, int]) -> Mapping[int, int]:
    return {number: ns + 3600 * 10**9 for number, ns in stamps_ns.items()}


def _first_third(stamps_ns: Mapping[int, int]) -> Mapping[int, int]:
    return dict(list(stamps_ns.items())[: len(stamps_ns) // 3])


FAULTS: dict[str, tuple[str, Changes]] = {
    "poses inverted": ("poses", {"pose": poses.inverse}),
    "poses of a camera": ("poses", {"pose": lambda T: poses.inverse(_BODY_CAM) @ T @ _BODY_CAM}),
    "poses in millimetres": ("poses", {"pose": change_pose(scale=1e3)}),
    "rotations transposed": ("poses", {"pose": change_pose(np.transpose)}),
    "points in millimetres": ("unit of points", _points(lambda p: 1e3 * p)),
    "points on a map": ("unit of points", _points(lambda p: p + [5e5, 5.4e6, 200.0])),
    "points in a camera's axes": ("axes", _points(lambda p: p @ _BODY_CAM[:3, :3])),
    "points with z down": ("axes", _points(lambda p: p * [1.0, -1.0, -1.0])),
    "points in the vehicle's frame": ("scanner's place", {"sweep": _in_the_vehicle}),
    "stamps in microseconds": ("stamps", {"stamp_ns": lambda _, ns: ns // 1000}),
    "stamps in reverse": ("stamps", {"stamp_ns": lambda _, ns: -ns}),
    "point times in microseconds": ("point times", {"sweep": _microseconds}),
    "reflectance from 0 to 255": (
        "intensity",
        {"sweep": lambda s: replace(s, intensity=255 * s.intensity)},
    ),
    "every second sweep broken off": ("scanner 0", {"sweep": _half}),
    "T_lidar_cam given as T_cam_lidar": ("calibration", _T_cam_lidar(poses.inverse)),
    "T_cam_lidar without the camera's axes": ("calibration", _T_cam_lidar(lambda T: _BODY_CAM @ T)),
    "camera's clock an hour off": ("images", {"image_stamps_ns": _hour_off}),
    "images of every third sweep only": ("images", {"image_stamps_ns": _first_third}),
    "images black": ("calibration", {"image": np.zeros_like}),
}
"""What is wrong: the check that must find it, and the changes of `Faulty`."""
