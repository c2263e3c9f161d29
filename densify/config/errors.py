# SPDX-License-Identifier: MIT
"""Define the errors that users can resolve, each with a one-line message."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

_LONG_VALUE = re.compile(r"""(?<!\w)'[^']{201,}'|"[^"]{201,}"|\S{301,}""")
_BREAK = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")
_MOST_CHARACTERS = 1000


def shorten_message(message: str) -> str:
    """Return the message on one line of at most 1000 characters, long quoted values cut to 200."""
    message = _LONG_VALUE.sub(lambda match: _cut(match[0], 200), _BREAK.sub(" ", message))
    return _cut(message, _MOST_CHARACTERS) if len(message) > _MOST_CHARACTERS else message


def _cut(text: str, num_characters: int) -> str:
    """Return begin and end of a text, in this number of characters."""
    end = num_characters // 4
    return f"{text[: num_characters - end - 3]}...{text[-end:]}"


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra, such as ``ros``, of this package."""
    return f"in the checkout of densify: pip install '.[{extra}]'"


def did_you_mean(got: str, known: Iterable[str]) -> str:
    """Return ``did you mean NAME? `` with the most similar known name, "" if none is similar."""
    close = difflib.get_close_matches(got, list(known), n=1, cutoff=0.6)
    return f"did you mean {close[0]}? " if close else ""


class _ShortError(Exception):
    def __init__(self, message: str, *args: object) -> None:
        super().__init__(shorten_message(message), *args)


class InputError(_ShortError):
    """Input, configuration or output path that cannot be used. The command line exits with 2."""


class OutputError(InputError):
    """A result that cannot be written: no permission, a full disk."""


class ComputationError(_ShortError):
    """A result that a stage found to be unreliable. The command line exits with 1."""


class SweepError(_ShortError):
    """An error of one sweep; ``frame`` is its frame number. Other sweeps may still be used."""

    def __init__(self, message: str, frame: int) -> None:
        super().__init__(message, frame)
        self.frame = frame

    def __str__(self) -> str:
        return str(self.args[0])


class UnfitSweepError(SweepError, InputError):
    """A sweep with too few points or an implausible stamp."""


class UnplacedSweepError(SweepError, ComputationError):
    """A sweep whose pose registration could not find."""


def is_out_of_memory(error: Exception) -> bool:
    """Return True if the error means that memory ran out, also when starting a thread."""
    return isinstance(error, MemoryError) or str(error) == "can't start new thread"
