# SPDX-License-Identifier: MIT
"""A progress bar on stderr, where that is a terminal."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from densify.geometry.types import Progress

_LAYOUT = "{desc:<10} {percentage:3.0f}%|{bar}| {n_fmt}/{total_fmt} [{elapsed}<{remaining}]"


@contextmanager
def progress_on_stderr() -> Iterator[Progress]:
    """Yield a function that shows that ``done`` of ``total`` parts of a stage are done."""
    from tqdm import tqdm

    hidden = not sys.stderr.isatty()
    with tqdm(total=1, file=sys.stderr, leave=False, bar_format=_LAYOUT, disable=hidden) as bar:

        def show(stage: str, done: int, total: int) -> None:
            if done < bar.n or total != bar.total:  # another stage
                bar.reset(total)
                bar.initial = done
            bar.n = done
            bar.set_description(stage)

        yield show
