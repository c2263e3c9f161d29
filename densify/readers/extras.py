# SPDX-License-Identifier: MIT
"""Packages that only some readers need, imported where they are used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from densify.errors import InputError


def needed(module: str, extra: str, what: str) -> Any:
    """The imported module. Raises InputError, with the command that installs it, if it is not
    installed.

    extra: of densify, that brings it. what: is to be read, such as "Argoverse 2 recordings".
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"{what} need the package {module.partition('.')[0]} ({error}); install it with "
            f"pip install 'densify[{extra}]'"
        ) from None
