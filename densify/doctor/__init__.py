# SPDX-License-Identifier: MIT
"""Examine a recording before it is densified: find probable errors and their remedies.

A check in `CHECKS` compares the `Sample` as given with versions corrected for common mistakes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from densify.config import Config
from densify.doctor import cameras, clocks, paths, points, rings
from densify.doctor.findings import FINE, SUSPICIOUS, UNKNOWN, WRONG, Finding, Verdict, finding
from densify.doctor.sample import Sample, Spot
from densify.geometry.types import LidarSequence
from densify.readers.timeline import format_frames

__all__ = ["CHECKS", "Diagnosis", "Finding", "Sample", "Spot", "Verdict", "examine"]

_SHORT = 0.3  # of the usual size
_FETCH = "fetch these files again; windows end before sweeps that cannot be read"


def check_sweep_files(sample: Sample) -> list[Finding]:
    """Report empty or short sweep files, and sweeps that cannot be read."""
    findings = []
    if sample.unreadable:
        frame, reason = next(iter(sample.unreadable.items()))
        text = (
            f"{len(sample.unreadable)} of the sweeps looked at cannot be read: frames "
            f"{format_frames(sample.unreadable)}; frame {frame}: {reason}"
        )
        findings.append(finding("reading", WRONG, text, _FETCH))
    sequence = sample.sequence
    sizes = sequence.sweep_bytes() if hasattr(sequence, "sweep_bytes") else {}
    if sizes:
        usual = float(np.median(list(sizes.values())))
        empty = [frame for frame, size in sizes.items() if size == 0]
        short = [frame for frame, size in sizes.items() if 0 < size < _SHORT * usual]
        text = f"{len(sizes)} sweeps of {usual / 1e6:.2f} MB, none empty or much shorter"
        if empty or short:
            text = (
                f"empty: {format_frames(empty)}; much shorter than the usual {usual / 1e6:.2f} MB: "
                f"{format_frames(short)}"
            )
        verdict = WRONG if empty else SUSPICIOUS if short else FINE
        values = {"num_empty": len(empty), "num_short": len(short), "usual_bytes": int(usual)}
        findings.append(finding("files", verdict, text, _FETCH, **values))
    return findings


def check_registration(sample: Sample) -> list[Finding]:
    """Report sweeps that odometry cannot register."""
    failures = [spot.failure for spot in sample.spots if spot.trajectory is None]
    if len(sample.timeline.frames) < 2:
        return [finding("registration", UNKNOWN, failures[0])]
    if not failures:
        speeds = ", ".join(f"{spot.speed_m_s:.1f}" for spot in sample.spots)
        return [finding("registration", FINE, f"odometry finds {speeds} m/s")]
    text = f"{len(failures)} of {len(sample.spots)} places cannot be registered: {failures[0]}"
    remedy = "mend what is wrong above first (unit of points, axes, stamps, point times)"
    return [finding("registration", WRONG, text, remedy)]


CHECKS: tuple[Callable[[Sample], list[Finding]], ...] = (
    check_sweep_files,
    clocks.check_stamps,
    clocks.check_point_times,
    points.check_units,
    points.check_frame,
    points.check_axes,
    points.check_sensors,
    points.check_directions,
    points.check_own_vehicle,
    points.check_intensity,
    check_registration,
    rings.check_rings,
    clocks.check_deskewing,
    paths.check_poses,
    cameras.check_cameras,
)


@dataclass(frozen=True)
class Diagnosis:
    """The findings about a recording."""

    sample: Sample  # sweeps that were examined
    findings: tuple[Finding, ...]  # findings in the order of `CHECKS`

    @property
    def worst(self) -> Verdict:
        """The most severe verdict."""
        return max((finding.verdict for finding in self.findings), default=Verdict.FINE)


def examine(sequence: LidarSequence, config: Config) -> Diagnosis:
    """Run all checks on a recording; at most 15 sweeps and about 40 images are read."""
    sample = Sample.of(sequence, config.register)
    return Diagnosis(sample, tuple(found for check in CHECKS for found in check(sample)))
