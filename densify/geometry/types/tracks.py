# SPDX-License-Identifier: MIT
"""Where moving objects were."""

from __future__ import annotations

from dataclasses import dataclass

from densify.geometry.arrays import Float, Int


@dataclass(frozen=True)
class ObjectTrack:
    """One moving object at n moments: the reference times of the sweeps that saw it, and of the
    key.

    instance: as in `Cloud`. size_m: (3,) length, width and height of the box around
    its points, in its own frame: x to where it moves at the key's moment, z along the key's, origin
    in the box's middle. frames: n sweeps, ascending. stamp_ns: (n,). T_key_object: (n,4,4), with
    the vehicle's own motion removed: the key's coordinates do not move. velocity_m_s: (n,3) of the
    box's middle, key frame. num_points: (n,) returns of that sweep.
    """

    instance: int
    size_m: Float
    frames: tuple[int, ...]
    stamp_ns: Int
    T_key_object: Float
    velocity_m_s: Float
    num_points: Int
