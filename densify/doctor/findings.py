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


def fine(check: str, evidence: str, **values: Value) -> Finding:
    """Return a finding that nothing is wrong."""
    return Finding(check, Verdict.FINE, evidence, values=values)


def unknown(check: str, evidence: str, **values: Value) -> Finding:
    """Return a finding that the recording does not show."""
    return Finding(check, Verdict.UNKNOWN, evidence, values=values)


def suspicious(check: str, evidence: str, remedy: str, **values: Value) -> Finding:
    """Return a finding that may be wrong."""
    return Finding(check, Verdict.SUSPICIOUS, evidence, remedy, values)


def wrong(check: str, evidence: str, remedy: str, **values: Value) -> Finding:
    """Return a finding that is wrong."""
    return Finding(check, Verdict.WRONG, evidence, remedy, values)
