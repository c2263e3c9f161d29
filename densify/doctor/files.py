# SPDX-License-Identifier: MIT
"""Files that cannot be read, and room for what is to be written."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from densify.doctor.findings import Finding, Verdict, fine, wrong
from densify.doctor.sample import Sample
from densify.geometry.types import KnowsFiles
from densify.readers.timeline import format_frames

_BYTES_PER_KEY = 3_000_000  # one camera and the cloud; two thirds of that without
_SHORT = 0.3  # of the usual size


def check_sweep_files(sample: Sample) -> list[Finding]:
    """Sizes of all files, where each sweep has one, and whether those looked at could be read."""
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
    if isinstance(sample.sequence, KnowsFiles):
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
    return Finding(
        "files",
        Verdict.WRONG if empty else Verdict.SUSPICIOUS,
        f"empty: {format_frames(empty)}; much shorter than the usual {usual / 1e6:.2f} MB: "
        f"{format_frames(short)}",
        "fetch these files again; windows end before sweeps that cannot be read",
        values,
    )


def check_room(sample: Sample, folder: Path) -> list[Finding]:
    """Free space for a data set of all keys."""
    num = len(sample.timeline.frames)
    needed, free = num * _BYTES_PER_KEY, shutil.disk_usage(folder).free
    text = (
        f"{free / 1e9:.1f} GB free in {folder.absolute()}, a data set of all {num} keys takes "
        f"about {needed / 1e9:.1f} GB"
    )
    short = free < needed
    return [
        Finding(
            "room",
            Verdict.SUSPICIOUS if short else Verdict.FINE,
            text,
            "give another --out, or fewer --keys" * short,
            {"free_bytes": free, "needed_bytes": needed},
        )
    ]
