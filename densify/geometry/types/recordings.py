# SPDX-License-Identifier: MIT
"""Define the interface of readers, boxes around objects, and exact truth of simulations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float, Float32, Int
from densify.geometry.types.depth import Camera
from densify.geometry.types.sweeps import Sweep


class LidarSequence(Protocol):
    """A recording, opened lazily. A reader is one class with these members.

    Frames are absolute numbers. Methods raise InputError with a full sentence for anything missing
    or malformed. A reader may also have these methods, which are found by name:

    - findings() -> Sequence[tuple[str, str]]: findings and assumptions, short labels and texts.
    - gaps() -> Sequence[str]: missing parts and what is assumed instead, a sentence each.
    - prepare(frames, images=()): make these sweeps and images (camera, number), read next.
    - T_world_cam(camera, number) -> (4,4): pose of an image's exposure in the lidar's world.
    - boxes(frame) -> Boxes | None: around objects in a sweep; None where nobody drew any.
    - sweep_bytes() -> Mapping[int, int]: size of each sweep's file; empty for shared files.
    - num_rows(frame) -> int: number of rows of the sweep's file, valid or not.
    """

    @property
    def name(self) -> str:
        """Name for people and outputs."""

    @property
    def frames(self) -> Sequence[int]:
        """Numbers of the existing sweeps, ascending."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""

    @property
    def truth(self) -> Truth | None:
        """Exact truth, None if there is none."""

    def __getitem__(self, frame: int) -> Sweep: ...

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep, without reading its points."""
        ...

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """Return the exposure time of each of the camera's images (its middle row), by number.

        Both ascend. Numbers need not be those of the sweeps.
        """
        ...

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """Return an image, (H,W,3) RGB."""
        ...

    def T_world_lidar(self, frame: int) -> Float:
        """Return the data set's own pose (4,4) at the sweep's reference time."""
        ...


@dataclass(frozen=True)
class BoxView:
    """The image of the one camera in which boxes were drawn.

    Attributes:
        left_out_px: (R,4) left, top, right, bottom of rectangles without boxes.
    """

    camera: Camera
    left_out_px: Float


@dataclass(frozen=True)
class Boxes:
    """The K boxes of one sweep.

    Attributes:
        track: (K,) text, the same for an object in every sweep; empty for one that is not
            tracked.
        T_lidar_box: (K,4,4) lidar frame at the reference time; the points are assumed to be
            ego-motion compensated. The origin of a box is in its middle, x to the front, z up.
        size_m: (K,3) length, width, height.
        offset_ns: (K,) int64 since the reference time, where boxes are in the lidar frame of
            another time; None for 0.
        lidar: (K,) number of the scanner whose points a box is drawn around, -1 for all; None
            for all.
        view: None for boxes all round.
    """

    track: NDArray[Any]
    T_lidar_box: Float
    size_m: Float
    offset_ns: Int | None = None
    lidar: Int | None = None
    view: BoxView | None = None


@dataclass(frozen=True)
class SweepTruth:
    """The truth of the N points of a raw sweep, row by row.

    Attributes:
        T_world_lidar: (4,4) at the reference time.
        points: (N,3) lidar frame at the reference time.
        instance: (N,) int32, -1 static.
        moving: (N,) bool, moves at that time.
    """

    T_world_lidar: Float
    points: Float
    instance: NDArray[np.int32]
    moving: Bool


class Truth(Protocol):
    """Exact truth of a simulated sequence."""

    def sweep(self, frame: int) -> SweepTruth:
        """Return the truth of a sweep."""

    def displacement(self, frame: int, target: int) -> Float:
        """Return the (N,3) scene flow from the reference time of ``frame`` to that of ``target``.

        It is in the lidar frame of ``frame``, with ego-motion removed.
        """
        ...

    def depth_m(self, camera: str, number: int) -> Float32:
        """Return (H,W) the true depth of an image, 0 none.

        It is the nearest solid surface at the exposure of each row, in the camera's own measure
        (`Camera.measure`).
        """
        ...

    def moving_mask(self, camera: str, number: int) -> Bool:
        """Return (H,W) True for pixels of moving objects."""
        ...
