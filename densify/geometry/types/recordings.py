# SPDX-License-Identifier: MIT
"""Recordings: what a reader offers, and exact truth where there is some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from densify.geometry.arrays import Bool, Float, Float32
from densify.geometry.types.boxes import Boxes
from densify.geometry.types.depth import Camera
from densify.geometry.types.sweeps import Sweep


@dataclass(frozen=True)
class SweepTruth:
    """What really was where, for the N points of a raw sweep, row by row.

    T_world_lidar: (4,4) at the reference time. points: (N,3) lidar frame at the reference time.
    instance: (N,) int32, -1 the static world. moving: (N,) bool, moves at that time.
    """

    T_world_lidar: Float
    points: Float
    instance: NDArray[np.int32]
    moving: Bool


class Truth(Protocol):
    """Exact truth of a simulated sequence."""

    def sweep(self, frame: int) -> SweepTruth: ...

    def displacement(self, frame: int, target: int) -> Float:
        """(N,3) scene flow from the reference time of ``frame`` to that of ``target``, in the
        lidar frame of ``frame``, ego-motion removed."""
        ...

    def depth_m(self, camera: str, number: int) -> Float32:
        """(H,W) of the nearest solid surface at the image's own time (of each row), 0 none: in the
        camera's own measure, z or range (`densify.geometry.types.Camera.measure`)."""
        ...

    def moving_mask(self, camera: str, number: int) -> Bool:
        """(H,W), True where the pixel shows something that moves."""
        ...


class LidarSequence(Protocol):
    """A recording, opened lazily. A reader for a data set is one class with these members.

    Frames are absolute numbers. Methods raise InputError with a full sentence for anything missing
    or malformed.
    """

    @property
    def name(self) -> str: ...

    @property
    def frames(self) -> Sequence[int]:
        """Numbers of the sweeps that exist, ascending."""
        ...

    @property
    def cameras(self) -> Mapping[str, Camera]: ...

    @property
    def truth(self) -> Truth | None: ...

    def __getitem__(self, frame: int) -> Sweep: ...

    def stamp_ns(self, frame: int) -> int:
        """Reference time of a sweep, without reading its points."""
        ...

    def image_stamps_ns(self, camera: str) -> Mapping[int, int]:
        """When each of the camera's images that exist was exposed (its middle row), by the image's
        number, ascending in both. Numbers need not be those of the sweeps."""
        ...

    def image(self, camera: str, number: int) -> NDArray[np.uint8]:
        """(H,W,3) RGB."""
        ...

    def T_world_lidar(self, frame: int) -> Float:
        """(4,4) the data set's own pose at the sweep's reference time."""
        ...


@runtime_checkable
class SaysWhatItFound(Protocol):
    """A sequence whose form had to be found out; a reader may have this member."""

    def findings(self) -> Sequence[tuple[str, str]]:
        """What was found out or assumed, for a person: short labels and texts."""
        ...


@runtime_checkable
class KnowsItsGaps(Protocol):
    """A sequence that can do without some of its files; a reader may have this member."""

    def gaps(self) -> Sequence[str]:
        """What is missing and what is assumed instead, a sentence each."""
        ...


@runtime_checkable
class MakesFrames(Protocol):
    """A sequence that has to make its sweeps and images, which takes long; a reader may have this
    member."""

    def prepare(self, frames: Sequence[int], images: Sequence[tuple[str, int]] = ()) -> None:
        """Make these sweeps and images (camera and number) side by side; they are asked for
        next."""
        ...


@runtime_checkable
class KnowsImagePoses(Protocol):
    """A sequence that has a pose for each image; a reader may have this member."""

    def T_world_cam(self, camera: str, number: int) -> Float:
        """(4,4) the data set's own pose at the exposure, in the world of `T_world_lidar`."""
        ...


@runtime_checkable
class KnowsBoxes(Protocol):
    """A sequence with boxes around objects, tracked from sweep to sweep; a reader may have this
    member."""

    def boxes(self, frame: int) -> Boxes | None:
        """None for a sweep that nobody drew boxes in."""
        ...


@runtime_checkable
class KnowsFiles(Protocol):
    """A sequence that keeps each sweep in a file of its own; a reader may have this member."""

    def sweep_bytes(self) -> Mapping[int, int]:
        """The size of each sweep's file, by frame; empty where sweeps share files."""
        ...


@runtime_checkable
class KnowsRows(Protocol):
    """A sequence whose sweeps' files have rows that are no valid returns; a reader may have this
    member."""

    def num_rows(self, frame: int) -> int:
        """How many rows the sweep's file has, valid or not."""
        ...
