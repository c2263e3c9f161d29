# SPDX-License-Identifier: MIT
"""Looks a recording over before it is densified: what may be wrong with it, and what mends it.

A check is a function of the `Sample` and one line in `CHECKS`. It measures, and compares what the
recording says with what it would say under the usual mistakes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from densify.config import Config
from densify.doctor import cameras, clocks, paths, points, rings
from densify.doctor.findings import Finding, Verdict, fine, suspicious, unknown, wrong
from densify.doctor.sample import Sample, Spot
from densify.geometry.types import LidarSequence
from densify.readers.timeline import format_frames

__all__ = ["CHECKS", "Diagnosis", "Finding", "Sample", "Spot", "Verdict", "examine"]

_SHORT = 0.3  # of the usual size
_CAUSES = ("unit of points", "axes", "stamps", "point times")


def check_sweep_files(sample: Sample) -> list[Finding]:
    """Compare the sizes of the sweeps' files; name sweeps that cannot be read."""
    findings = []
    if sample.unreadable:
        frame, reason = next(iter(sample.unreadable.items()))
        findings.append(
            wrong(
                "reading",
                f"{len(sample.unreadable)} of the sweeps looked at cannot be read: frames "
                f"{format_frames(sample.unreadable)}; frame {frame}: {reason}",
                "fetch these files again; windows end before them",
                num_unreadable=len(sample.unreadable),
            )
        )
    if hasattr(sample.sequence, "sweep_bytes"):
        sizes = sample.sequence.sweep_bytes()
        findings += [_sizes(sizes)] if sizes else []
    return findings


def _sizes(sizes: Mapping[int, int]) -> Finding:
    usual = float(np.median(list(sizes.values())))
    empty = [frame for frame, size in sizes.items() if size == 0]
    short = [frame for frame, size in sizes.items() if 0 < size < _SHORT * usual]
    values = {"num_empty": len(empty), "num_short": len(short), "usual_bytes": int(usual)}
    if not empty and not short:
        text = f"{len(sizes)} sweeps of {usual / 1e6:.2f} MB, none empty or much shorter"
        return fine("files", text, **values)
    verdict = wrong if empty else suspicious
    return verdict(
        "files",
        f"empty: {format_frames(empty)}; much shorter than the usual {usual / 1e6:.2f} MB: "
        f"{format_frames(short)}",
        "fetch these files again; windows end before sweeps that cannot be read",
        **values,
    )


def check_registration(sample: Sample) -> list[Finding]:
    """Report where odometry cannot register the sweeps."""
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


CHECKS: tuple[Callable[[Sample, Config], list[Finding]], ...] = (
    lambda sample, _: check_sweep_files(sample),
    lambda sample, _: clocks.check_stamps(sample),
    lambda sample, _: clocks.check_point_times(sample),
    lambda sample, _: points.check_units(sample),
    lambda sample, _: points.check_axes(sample),
    lambda sample, config: points.check_sensors(sample, config.register),
    lambda sample, config: points.check_own_vehicle(sample, config.register),
    lambda sample, _: points.check_intensity(sample),
    lambda sample, _: check_registration(sample),
    lambda sample, _: rings.check_rings(sample),
    lambda sample, config: clocks.check_deskewing(sample, config.register),
    lambda sample, _: paths.check_poses(sample),
    lambda sample, _: cameras.check_cameras(sample),
)


@dataclass(frozen=True)
class Diagnosis:
    """sample: what was looked at. findings: in the order of `CHECKS`."""

    sample: Sample
    findings: tuple[Finding, ...]

    @property
    def worst(self) -> Verdict:
        return max((finding.verdict for finding in self.findings), default=Verdict.FINE)


def examine(sequence: LidarSequence, config: Config) -> Diagnosis:
    """Check a recording. At most fifteen of its sweeps and three images of each camera are read,
    however long it is.

    Raises InputError if none of these sweeps can be read.
    """
    sample = Sample.of(sequence, config.register)
    findings = [finding for check in CHECKS for finding in check(sample, config)]
    return Diagnosis(sample, tuple(findings))
