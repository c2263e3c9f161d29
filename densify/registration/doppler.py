# SPDX-License-Identifier: MIT
"""How fast a scanner goes, by the radial velocities that it measured itself.

What stands moves towards the scanner as the scanner moves towards it: at every point the radial
velocity is minus the scanner's velocity along the ray (Kellner et al., "Instantaneous Ego-Motion
Estimation using Doppler Radar", ITSC 2013).
"""

from __future__ import annotations

import numpy as np

from densify.geometry.types import Float, Sweep

_NUM_ROUNDS, _NUM_LAST = 30, 3
_NOISE_M_S = 0.2
_AGREES_M_S = 0.6  # for a sweep takes a tenth of a second, in which speeds change
_LEAST_POINTS, _LEAST_SHARE = 200, 0.5
_RIDGE = 1e-6  # keeps still what no ray tells, as of one wall


def measured_velocity(sweep: Sweep) -> Float | None:
    """(3,) m/s of the scanner in its own frame, around the sweep; None where too few radial
    velocities were measured, or no half of them agree: then most of what is seen moves.

    Least absolute deviations (iteratively reweighted), then least squares over what agrees to 0.6
    m/s. Turning is not seen: it moves nothing along a ray from the scanner.
    """
    if sweep.radial_velocity_m_s is None:
        return None
    known = np.flatnonzero(np.isfinite(sweep.radial_velocity_m_s))
    if len(known) < _LEAST_POINTS:
        return None
    away_m_s = sweep.radial_velocity_m_s[known].astype(np.float64)
    ray = sweep.points[known]
    if sweep.scanner_origins is not None:
        ray = ray - sweep.scanner_origins[sweep.lidar[known]]
    ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    off_m_s = np.zeros(len(known))
    for left in reversed(range(_NUM_ROUNDS)):
        if left < _NUM_LAST:
            weight = (off_m_s <= _AGREES_M_S).astype(np.float64)
        else:
            weight = _NOISE_M_S / np.maximum(off_m_s, _NOISE_M_S)
        weighted = ray * weight[:, None]
        normal = weighted.T @ ray + _RIDGE * len(ray) * np.eye(3)
        velocity_m_s = np.linalg.solve(normal, -weighted.T @ away_m_s)
        off_m_s = np.abs(away_m_s + ray @ velocity_m_s)
    return velocity_m_s if (off_m_s <= _AGREES_M_S).mean() >= _LEAST_SHARE else None
