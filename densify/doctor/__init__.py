# SPDX-License-Identifier: MIT
"""Examine a recording before it is densified: find probable errors and their remedies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from densify.config import Config
from densify.doctor import cameras, motion, stored
from densify.doctor.sample import Finding, Sample, Spot, Verdict
from densify.geometry.types import LidarSequence

__all__ = ["CHECKS", "Diagnosis", "Finding", "Sample", "Spot", "Verdict", "examine"]

CHECKS: tuple[Callable[[Sample], list[Finding]], ...] = (
    stored.check_sweep_files,
    stored.check_stamps,
    stored.check_point_times,
    stored.check_units,
    motion.check_frame,
    stored.check_axes,
    motion.check_sensors,
    stored.check_directions,
    motion.check_own_vehicle,
    stored.check_intensity,
    motion.check_registration,
    motion.check_rings,
    motion.check_deskewing,
    motion.check_poses,
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
    """Run all checks on a recording, by at most 15 sweeps and about 40 images, for a diagnosis."""
    sample = Sample.of(sequence, config.register)
    return Diagnosis(sample, tuple(finding for check in CHECKS for finding in check(sample)))
