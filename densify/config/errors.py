# SPDX-License-Identifier: MIT
"""The two ways a densify command can fail that are not a bug.

A message is one line: what, where, got, expected, what to do.
"""

from __future__ import annotations

import re

_LONG_VALUE = re.compile(r"""(?<!\w)'[^']{201,}'|"[^"]{201,}"|\S{301,}""")
_BREAK = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")
_MOST_CHARACTERS = 1000


def brief(message: str) -> str:
    """A message on one line, whose echo of the input is cut: quoted texts beyond 200 characters,
    words beyond 300 (paths are words), and what is still beyond 1,000 in its middle."""
    message = _BREAK.sub(" ", message)
    message = _LONG_VALUE.sub(lambda found: _cut(found[0], 200), message)
    return _cut(message, _MOST_CHARACTERS) if len(message) > _MOST_CHARACTERS else message


def _cut(text: str, num_characters: int) -> str:
    end = num_characters // 4
    return f"{text[: num_characters - end - 3]}...{text[-end:]}"


class _ShortError(Exception):
    def __init__(self, message: str, *others: object) -> None:
        super().__init__(brief(message), *others)


class InputError(_ShortError):
    """Input, configuration or output place that cannot be used. Exit code 2."""


class OutputError(InputError):
    """What is computed cannot be written: no permission, a full disk."""


class ComputationError(_ShortError):
    """A stage found that its result cannot be trusted. Exit code 1."""


class SweepError(_ShortError):
    """One sweep is in the way: without ``frame`` the others could be used."""

    def __init__(self, message: str, frame: int) -> None:
        super().__init__(message, frame)
        self.frame = frame

    def __str__(self) -> str:
        return str(self.args[0])


class UnfitSweepError(SweepError, InputError):
    """It holds too few points, or its stamp cannot be right."""


class UnplacedSweepError(SweepError, ComputationError):
    """Registration does not find where it is."""


def is_out_of_memory(error: Exception) -> bool:
    """Whether the system had none left: also for the stack of one more thread."""
    return isinstance(error, MemoryError) or str(error) == "can't start new thread"
