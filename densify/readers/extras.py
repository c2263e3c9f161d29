# SPDX-License-Identifier: MIT
"""Optional packages, imported where they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from densify.config.errors import InputError


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
