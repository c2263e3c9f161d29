# SPDX-License-Identifier: MIT
"""Judge the key sweeps of a training set beside their neighbours in the recording.

A limit for all recordings passes keys that are bad for their own, such as cut windows at its ends.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from densify.dataset.manifest import Key, KeyRecord

_LEAST_SHARE = 0.001
"""Smaller shares of ghosts or outliers do not matter to a training set."""
_SCORES = {"ghost": "ghosts", "outliers": "held-out outliers"}


def worse_than_neighbours(records: Mapping[Key, KeyRecord], max_ratio: float) -> dict[Key, str]:
    """Return finished keys with far more ghosts or outliers than others around -> what is worse.

    ``max_ratio`` is the greatest share, as a multiple of the median of the neighbours.
    """
    drives: dict[str, list[KeyRecord]] = defaultdict(list)
    for record in records.values():
        if record.status != "failed":
            drives[record.drive].append(record)
    found: dict[Key, list[str]] = defaultdict(list)
    for drive in drives.values():
        drive.sort(key=lambda record: record.key)
        for score, said in _SCORES.items():
            shares = [_worst(record, score) for record in drive]
            # Twice a window: the keys whose windows an end cuts are the minority of neighbours.
            for row in _outlying(shares, 2 * max(len(r.frames) for r in drive), max_ratio):
                if drive[row].status == "done":
                    found[drive[row].name].append(said)
    return {
        name: f"more than {max_ratio:g} times the {' and '.join(said)} of the neighbouring keys"
        for name, said in sorted(found.items())
    }


def _worst(record: KeyRecord, score: str) -> float:
    """Return a score of a key, that of its worst camera; NaN if unknown."""
    value = record.scores.get(score)
    values = value.values() if isinstance(value, Mapping) else [value]
    return max((v for v in values if v is not None), default=np.nan)


def _outlying(shares: Sequence[float], num_beside: int, max_ratio: float) -> Iterator[int]:
    """Yield the rows whose share exceeds the median of ``num_beside`` rows around by the ratio."""
    for row, share in enumerate(shares):
        begin = max(0, min(row - num_beside // 2, len(shares) - num_beside - 1))
        beside = np.array([*shares[begin:row], *shares[row + 1 : begin + num_beside + 1]])
        beside = beside[np.isfinite(beside)]
        # Two keys do not tell which of them is unusual.
        if len(beside) > 1 and share > max(_LEAST_SHARE, max_ratio * float(np.median(beside))):
            yield row
