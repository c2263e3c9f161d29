# SPDX-License-Identifier: MIT
"""How well flow agrees with measured radial velocities, which no step of it has to be told by a
label: scores for FMCW lidars."""

from __future__ import annotations

from typing import Any

import numpy as np

from densify.geometry.types import Cloud, RegisteredSweep

_LEAST_M_S = 0.5


def radial_velocity_scores(cloud: Cloud, registered: RegisteredSweep) -> dict[str, Any] | None:
    """What the velocities of a key's own points leave of their measured radial velocities; None
    where none were measured.

    cloud: at the key's moment, in its frame. registered: the key's sweep. ``num_points`` with a
    velocity; ``num_moving`` of them, those that move by the flow or by more than 0.5 m/s along
    their rays; over these ``rms_m_s`` of measured minus estimated, ``rms_standing_m_s`` if nothing
    moved, and ``unexplained``, the share that is off by more than 0.5 m/s. None over no points.
    """
    sweep = registered.sweep
    if sweep.radial_velocity_m_s is None:
        return None
    own = np.flatnonzero((cloud.frame == sweep.frame) & ~cloud.far)
    order = np.argsort(sweep.row)
    at = order[np.searchsorted(sweep.row, cloud.row[own], sorter=order)]
    measured = sweep.radial_velocity_m_s[at].astype(np.float64)
    estimated = np.einsum("ni,ni->n", registered.rays()[0][at], cloud.velocity_m_s[own])
    known = np.isfinite(measured)
    moving = known & (cloud.moving[own] | (np.abs(measured) > _LEAST_M_S))
    off_m_s = np.abs(measured - estimated)[moving]
    return {
        "num_points": int(known.sum()),
        "num_moving": int(moving.sum()),
        "rms_m_s": _rms(off_m_s),
        "rms_standing_m_s": _rms(measured[moving]),
        "unexplained": float((off_m_s > _LEAST_M_S).mean()) if len(off_m_s) else None,
    }


def _rms(values: np.ndarray) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None
