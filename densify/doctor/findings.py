# SPDX-License-Identifier: MIT
"""Define the findings of a check and their verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Verdict(IntEnum):
    """The severity of a finding.

    UNKNOWN: the recording does not show it, for instance because the vehicle stands.
    """

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

    Attributes:
        check: Subject, such as "stamps".
        evidence: One sentence with the number that the verdict rests on.
        remedy: The option or line that mends it; empty if nothing is wrong.
        values: The numbers by name, with units in the names.
    """

    check: str
    verdict: Verdict
    evidence: str
    remedy: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)


def finding(
    check: str, verdict: Verdict, evidence: str, remedy: str = "", **values: Value
) -> Finding:
    """Return a finding, without the remedy unless something may be wrong."""
    return Finding(check, verdict, evidence, remedy if verdict >= SUSPICIOUS else "", values)
