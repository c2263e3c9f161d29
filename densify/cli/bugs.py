# SPDX-License-Identifier: MIT
"""What nobody foresaw, kept in a file for a report."""

from __future__ import annotations

import os
import platform
import sys
import tempfile
import time
import traceback
from pathlib import Path

from densify import __version__
from densify.config.errors import InputError


def kept(error: BaseException) -> Path:
    """The file with the traceback, the versions and the command: in the user's cache, or else in
    the system's temporary folder."""
    text = "\n".join(
        [
            f"densify {__version__}, Python {platform.python_version()}, {platform.platform()}",
            f"command: {sys.argv}",
            "".join(traceback.format_exception(error)),
        ]
    )
    number, path = tempfile.mkstemp(".log", time.strftime("bug-%Y%m%d-%H%M%S-"), _folder())
    with open(number, "w", encoding="utf-8", errors="backslashreplace") as file:
        file.write(text)
    return Path(path)


def _folder() -> Path | None:
    from densify.config.user_folder import own_folder

    try:
        folder = own_folder("bugs")
        folder.mkdir(exist_ok=True)
    except (InputError, OSError):
        return None
    return folder if os.access(folder, os.W_OK) else None
