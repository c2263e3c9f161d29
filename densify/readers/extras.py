# SPDX-License-Identifier: MIT
"""Optional packages, imported where they are used, and one error for whatever a malformed
description raises."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from densify.config.errors import InputError
from densify.config.file_content import reason

_MALFORMED = (LookupError, TypeError, ValueError, AttributeError, OverflowError)


def needed(module: str, extra: str, what: str) -> Any:
    """Return the imported module. Raises InputError, with what mends it, if that fails.

    extra: of densify, that brings it. what: needs it, such as "Argoverse 2 recordings".
    """
    package = module.partition(".")[0]
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(
            f"{what} need the package {package} ({error}); install it with "
            f"pip install 'densify[{extra}]'"
        ) from None
    except ImportError as error:
        raise InputError(
            f"{what} need the package {package}, which is installed and cannot be loaded here "
            f"({error}); install the system's library that it names"
        ) from None


@contextmanager
def described_in(where: Path | str, expected: str) -> Iterator[None]:
    """Raise InputError, which begins with ``where``, for a key that is absent or a value of another
    kind in what is read meanwhile."""
    try:
        yield
    except InputError:
        raise
    except _MALFORMED as error:
        got = f"no {error}" if isinstance(error, KeyError) else reason(error)
        raise InputError(f"{where}: {got:.200}; expected {expected}; fetch it again") from None
