# SPDX-License-Identifier: MIT
"""The findings of a check and their verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Verdict(IntEnum):
    """How bad a finding is. UNKNOWN: the recording does not show it, for instance because the
    vehicle stands still."""

    FINE = 0
    UNKNOWN = 1
    SUSPICIOUS = 2
    WRONG = 3

    def __str__(self) -> str:
        return self.name.lower()


FINE, UNKNOWN, SUSPICIOUS, WRONG = Verdict
Value = float | int | str | list[float]


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    check: the subject, such as "stamps". evidence: one sentence with the number that the verdict
    rests on. remedy: the option or line that mends it; empty where nothing is wrong. values: the
    numbers by name, with units in the names.
    """

    check: str
    verdict: Verdict
    evidence: str
    remedy: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)


def finding(
    check: str, verdict: Verdict, evidence: str, remedy: str = "", **values: Value
) -> Finding:
    """Return a finding; without the remedy unless something may be wrong."""
    return Finding(check, verdict, evidence, remedy if verdict >= SUSPICIOUS else "", values)
