# SPDX-License-Identifier: MIT
"""What a verb says on stdout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Answer:
    """text: for people. facts: for programs (``--json``); where a verb answers several times, lists
    are joined. files: that were written. first: those of them to open first, and what they show."""

    text: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    files: Sequence[Path] = ()
    first: Mapping[Path, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """What people read: the text, every file, and those to open first."""
        lines = [self.text] if self.text else []
        lines += map(str, self.files)
        if self.first:
            width = max(len(str(path)) for path in self.first)
            lines += ["open first:"]
            lines += [f"  {path!s:<{width}}  {what}" for path, what in self.first.items()]
        return lines


def first_of(files: Sequence[Path], kinds: Mapping[str, str], most: int = 3) -> dict[Path, str]:
    """The files to open first. kinds: file, by the end of its path, to what it shows; those named
    first come first, and of several files of a kind one."""
    first: dict[Path, str] = {}
    for pattern, what in kinds.items():
        found = next((f for f in files if f.match(pattern) and f not in first), None)
        if found is not None and len(first) < most:
            first[found] = what
    return first
