# SPDX-License-Identifier: MIT
"""Radial velocities, as FMCW lidars measure them: the component of velocity along the ray."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from densify.geometry import poses
from densify.geometry.types import Bool, Float, Float32, Int, RegisteredSweep

_LEAST_M_S = 0.5
_SPREADS = 6.0  # of what stands: its noise, and what registration leaves of the scanner's motion
_MAD_TO_STD = 1.4826
_AGREES_M_S = 0.3
_SWINGS_M_S = 3.0


@dataclass(frozen=True)
class Radial:
    """The radial velocities of a sweep's points, ego motion removed.

    ray: (N,3) unit vectors from the scanner, world axes. m_s: (N,) along the ray, NaN where not
    measured. spread_m_s: robust standard deviation, mostly of static points.
    """

    ray: Float
    m_s: Float32
    spread_m_s: float

    @staticmethod
    def of(registered: RegisteredSweep) -> Radial | None:
        """None where the sweep has none."""
        m_s = registered.sweep.radial_velocity_m_s
        if m_s is None:
            return None
        known = np.abs(m_s[np.isfinite(m_s)])
        spread_m_s = _MAD_TO_STD * float(np.median(known)) if len(known) else 0.0
        ray, _ = registered.rays()
        return Radial(poses.rotate(registered.T_world_lidar, ray), m_s, spread_m_s)

    def rows(self, rows: Int | Bool) -> Radial:
        """Return the radial velocities of some points."""
        return Radial(self.ray[rows], self.m_s[rows], self.spread_m_s)

    @staticmethod
    def together(parts: list[Radial]) -> Radial:
        """Concatenate those of several sweeps."""
        return Radial(
            np.concatenate([part.ray for part in parts]),
            np.concatenate([part.m_s for part in parts]),
            max(part.spread_m_s for part in parts),
        )

    def moving(self) -> Bool:
        """Return (N,) True for points faster along the ray than noise can be."""
        return np.abs(np.nan_to_num(self.m_s)) > max(_LEAST_M_S, _SPREADS * self.spread_m_s)

    def corrected(self, velocity_m_s: Float) -> Float:
        """Return the velocity (3,) of a rigid object with its component along the mean ray of its
        points replaced by the measured one."""
        known = np.isfinite(self.m_s)
        if not known.any():
            return velocity_m_s
        ray = self.ray[known].mean(axis=0) * [1.0, 1.0, 0.0]
        length = np.linalg.norm(ray)
        if length < 0.5:  # from below, or from all around
            return velocity_m_s
        missing_m_s = np.median(self.m_s[known] - self.ray[known] @ velocity_m_s)
        return velocity_m_s + missing_m_s * ray / length**2

    def contradicts(self, velocity_m_s: Float) -> Bool:
        """Return (N,) True for points much slower or faster than (N,3); limbs swing at some m/s."""
        off_m_s = np.abs(self.m_s - np.einsum("ni,ni->n", self.ray, velocity_m_s))
        return np.nan_to_num(off_m_s) > max(_SWINGS_M_S, _SPREADS * self.spread_m_s)

    def agrees(self, velocity_m_s: Float) -> bool:
        """Return True if velocities (N,3) have these radial velocities, in the median; True where
        none was measured."""
        known = np.isfinite(self.m_s)
        if not known.any():
            return True
        off_m_s = np.abs(self.m_s - np.einsum("ni,ni->n", self.ray, velocity_m_s))[known]
        return float(np.median(off_m_s)) <= max(_AGREES_M_S, _SPREADS * self.spread_m_s)
