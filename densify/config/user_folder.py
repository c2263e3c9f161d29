# SPDX-License-Identifier: MIT
"""Folders of the user's own cache, in which nobody else can put anything."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

import platformdirs

from densify.config.errors import InputError


def own_folder(name: str) -> Path:
    """Return that folder of the user's cache directory, or of the one that the environment variable
    DENSIFY_CACHE_DIR names. It is made with mode 0700 where that is possible.

    Raises InputError if others can write to it.
    """
    named = os.environ.get("DENSIFY_CACHE_DIR")
    root = Path(named or platformdirs.user_cache_dir("densify"))
    for folder in (root, root / name):
        with suppress(OSError):  # whoever writes to it reports that
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if others_can_write(folder):
            raise InputError(
                f"cache {folder}: others can write to it, expected a folder of yours alone; "
                f"chmod 700 {folder}, or name another by DENSIFY_CACHE_DIR"
            )
    return root / name


def others_can_write(folder: Path) -> bool:
    """Return True if anybody but this user and root can write to an existing folder."""
    try:
        found = folder.stat()
    except OSError:
        return False
    mine = found.st_uid in (0, os.getuid())
    return not mine or bool(found.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
