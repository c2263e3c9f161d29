# SPDX-License-Identifier: MIT
"""Looks a recording over before it is densified: what may be wrong with it, and what mends it.

A check is a function of the `Sample` and one line in `CHECKS`. It measures, and compares what the
recording says with what it would say under the usual mistakes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from densify.config import Config
from densify.doctor import cameras, clocks, deskewing, files, paths, points, rings
from densify.doctor.findings import Finding, Verdict, fine, unknown, wrong
from densify.doctor.sample import Sample, Spot
from densify.geometry.types import LidarSequence

__all__ = ["CHECKS", "Diagnosis", "Finding", "Sample", "Spot", "Verdict", "examine"]

CHECKS: tuple[Callable[[Sample, Config], list[Finding]], ...] = (
    lambda sample, _: files.check_sweep_files(sample),
    lambda sample, _: clocks.check_stamps(sample),
    lambda sample, _: clocks.check_point_times(sample),
    lambda sample, _: points.check_units(sample),
    lambda sample, _: points.check_axes(sample),
    lambda sample, config: points.check_sensors(sample, config.register),
    lambda sample, config: points.check_own_vehicle(sample, config.register),
    lambda sample, _: points.check_intensity(sample),
    lambda sample, _: registration_of(sample),
    lambda sample, _: rings.check_rings(sample),
    lambda sample, config: deskewing.check_deskewing(sample, config.register),
    lambda sample, _: paths.check_poses(sample),
    lambda sample, _: cameras.check_cameras(sample),
)
_CAUSES = ("unit of points", "axes", "stamps", "point times")


@dataclass(frozen=True)
class Diagnosis:
    """sample: what was looked at. findings: in the order of `CHECKS`."""

    sample: Sample
    findings: tuple[Finding, ...]

    @property
    def worst(self) -> Verdict:
        return max((finding.verdict for finding in self.findings), default=Verdict.FINE)


def examine(sequence: LidarSequence, config: Config, folder: Path | None = None) -> Diagnosis:
    """Check a recording. At most fifteen of its sweeps and three images of each camera are read,
    however long it is.

    folder: where a data set would be written; its free space is checked. Raises InputError if not
    one of the sweeps looked at can be read.
    """
    sample = Sample.of(sequence, config.register)
    findings = [finding for check in CHECKS for finding in check(sample, config)]
    if folder is not None:
        findings += files.check_room(sample, folder)
    return Diagnosis(sample, tuple(findings))


def registration_of(sample: Sample) -> list[Finding]:
    """Whether odometry can lay the sweeps upon each other."""
    failures = [spot.failure for spot in sample.spots if spot.trajectory is None]
    if len(sample.timeline.frames) < 2:
        return [unknown("registration", failures[0])]
    if not failures:
        speeds = ", ".join(f"{spot.speed_m_s:.1f}" for spot in sample.spots)
        return [fine("registration", f"odometry finds {speeds} m/s")]
    return [
        wrong(
            "registration",
            f"{len(failures)} of {len(sample.spots)} places cannot be registered: {failures[0]}",
            f"mend what is wrong above first ({', '.join(_CAUSES)})",
        )
    ]
