# SPDX-License-Identifier: MIT
"""Define the interface of readers, boxes around objects, and the ground truth of simulations."""

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

    Frames are the data set's own sweep numbers. Methods raise InputError with a full sentence for
    anything missing or malformed. A reader may also have these methods, which are looked up by
    name:

    - findings() -> Sequence[tuple[str, str]]: short labels and texts of findings and assumptions.
    - gaps() -> Sequence[str]: a sentence for each missing part and its replacement.
    - prepare(frames, images=()): render these sweeps and images (camera, number) in parallel.
    - T_world_cam(camera, number) -> (4,4): camera pose at an image's exposure in the lidar's world.
    - boxes(frame) -> Boxes | None: annotated boxes of a sweep; None if it is not annotated.
    - sweep_bytes() -> Mapping[int, int]: file size of each sweep by frame; empty for shared files.
    - num_rows(frame) -> int: number of rows of the sweep's file, valid and invalid.
    """

    @property
    def name(self) -> str:
        """Name of the recording in messages and outputs."""

    @property
    def frames(self) -> Sequence[int]:
        """Frame numbers of the existing sweeps, ascending."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by name."""

    @property
    def truth(self) -> Truth | None:
        """Ground truth of a simulation, None for a real recording."""

    def __getitem__(self, frame: int) -> Sweep: ...

    def stamp_ns(self, frame: int) -> int:
        """Return the reference time of a sweep, without reading its points."""
        ...

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """Return image number -> exposure time of the middle row, for all images of a camera.

        Numbers and times both ascend. Image numbers may differ from frame numbers.
        """
        ...

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """Return the (H,W,3) RGB image of this number."""
        ...

    def T_world_lidar(self, frame: int) -> Float:
        """Return the data set's own (4,4) lidar pose at the sweep's reference time."""
        ...


def in_one_line(sequence: LidarSequence) -> str:
    """Return what a recording holds, for its ``repr``."""
    frames, cameras = sequence.frames, ", ".join(sequence.cameras) or "none"
    span = f" from {frames[0]} to {frames[-1]}" if len(frames) else ""
    return f"<{sequence.name}: {len(frames)} sweeps{span}; cameras: {cameras}>"


@dataclass(frozen=True)
class BoxView:
    """The camera image in which an annotator drew the boxes."""

    camera: Camera
    # (R,4) left, top, right, bottom of R image rectangles that are not annotated
    left_out_px: Float


@dataclass(frozen=True)
class Boxes:
    """The K annotated boxes of one sweep."""

    # (K,) text identifying the object in all sweeps; empty for an untracked object
    track: NDArray[Any]
    # (K,4,4) pose of each box in the lidar frame at the reference time, for points compensated for
    # ego-motion. The box frame is in the middle of the box, x to the front, z up.
    T_lidar_box: Float
    size_m: Float  # (K,3) length, width, height
    # (K,) time since the reference time at which the lidar frame of ``T_lidar_box`` is taken; None
    # for 0
    offset_ns: Int | None = None
    # (K,) index of the scanner whose points a box encloses, -1 for all scanners; None if every box
    # encloses the points of all scanners
    lidar: Int | None = None
    # Image in which the boxes were drawn; None for boxes all around the vehicle
    view: BoxView | None = None


@dataclass(frozen=True)
class SweepTruth:
    """The ground truth of the N points of a raw sweep, in the same order."""

    T_world_lidar: Float  # (4,4) lidar pose at the reference time
    points: Float  # (N,3) metres, positions at the reference time, lidar frame at that time
    instance: NDArray[np.int32]  # (N,) number of the object, -1 for the static scene
    moving: Bool  # (N,) True if the object moves at the reference time


class Truth(Protocol):
    """Exact ground truth of a simulated sequence."""

    def sweep(self, frame: int) -> SweepTruth:
        """Return the ground truth of a sweep."""

    def displacement(self, frame: int, target: int) -> Float:
        """Return the (N,3) true scene flow (m) of a sweep's points to the time of sweep ``target``.

        It is in the lidar frame of ``frame``, with ego-motion removed, and 0 for static points.
        """
        ...

    def depth_m(self, camera: str, number: int) -> Float32:
        """Return the (H,W) true depth of an image in metres, 0 where the ray meets no surface.

        It is the depth of the nearest solid surface at the exposure of each row, in the camera's
        own measure (`Camera.measure`).
        """
        ...

    def moving_mask(self, camera: str, number: int) -> Bool:
        """Return (H,W) True for pixels of moving objects."""
        ...
