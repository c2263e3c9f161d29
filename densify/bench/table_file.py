# SPDX-License-Identifier: MIT
"""The JSON file of a benchmark's numbers."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from densify import __version__
from densify.config.errors import InputError
from densify.outputs.atomic import write_file


def write_table(path: Path, numbers: Mapping[str, Any]) -> None:
    """Write the numbers with the machine they are of. Appears only when complete.

    Raises InputError if it cannot be written.
    """
    machine = {"python": platform.python_version(), "num_cores": os.cpu_count()}
    whole = {"densify": __version__, "machine": machine, **numbers}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, (json.dumps(whole, indent=2, allow_nan=False) + "\n").encode())
    except OSError as error:
        raise InputError(f"--out {path}: cannot be written: {error.strerror or error}") from error
