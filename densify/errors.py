# SPDX-License-Identifier: MIT
"""The two ways a densify command can fail that are not a bug.

A message is one line: what, where, got, expected, what to do.
"""

from __future__ import annotations


class InputError(Exception):
    """Input, configuration or output place that cannot be used. Exit code 2."""


class OutputError(InputError):
    """What is computed cannot be written: no permission, a full disk."""


class ComputationError(Exception):
    """A stage found that its result cannot be trusted. Exit code 1."""


class SweepError(ComputationError):
    """One sweep is in the way: without ``frame`` the others could be used."""

    def __init__(self, message: str, frame: int) -> None:
        super().__init__(message, frame)
        self.frame = frame

    def __str__(self) -> str:
        return str(self.args[0])
