# SPDX-License-Identifier: MIT
"""What a check finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Verdict(IntEnum):
    """How bad it is. UNKNOWN: the recording does not show it, for instance because it stands."""

    FINE = 0
    UNKNOWN = 1
    SUSPICIOUS = 2
    WRONG = 3

    def __str__(self) -> str:
        return self.name.lower()


@dataclass(frozen=True)
class Finding:
    """check: what was looked at, such as "stamps". evidence: one sentence with the number that the
    verdict rests on. remedy: the option or line that mends it; empty where nothing is wrong.
    values: the numbers by name, with units in the names."""

    check: str
    verdict: Verdict
    evidence: str
    remedy: str = ""
    values: Mapping[str, float | int | str | list[float]] = field(default_factory=dict)
