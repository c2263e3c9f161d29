# SPDX-License-Identifier: MIT
"""Define the findings of a check and their verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum


class Verdict(IntEnum):
    """The severity of a finding."""

    FINE = 0
    UNKNOWN = 1  # the recording allows no verdict, such as one of a vehicle at rest
    SUSPICIOUS = 2
    WRONG = 3

    def __str__(self) -> str:
        return self.name.lower()


FINE, UNKNOWN, SUSPICIOUS, WRONG = Verdict
Value = float | int | str | list[float]


@dataclass(frozen=True)
class Finding:
    """The result of one check."""

    check: str  # name of the checked property, such as "stamps"
    verdict: Verdict  # severity
    evidence: str  # sentence with the number on which the verdict is based
    # Option or line that corrects the error; empty if the verdict is FINE or UNKNOWN
    remedy: str = ""
    values: Mapping[str, Value] = field(default_factory=dict)  # name (with unit) -> measured number


def finding(
    check: str, verdict: Verdict, evidence: str, remedy: str = "", **values: Value
) -> Finding:
    """Return a finding, with the remedy only if the verdict is SUSPICIOUS or WRONG."""
    return Finding(check, verdict, evidence, remedy if verdict >= SUSPICIOUS else "", values)
