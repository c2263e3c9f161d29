# SPDX-License-Identifier: MIT
"""Values as JSON and YAML can say them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from densify.outputs.atomic import write_file


def write_json(path: Path, value: Mapping[str, Any]) -> None:
    """Write `plain` of a mapping, indented."""
    write_file(path, (json.dumps(plain(value), indent=2, allow_nan=False) + "\n").encode())


def plain(value: Any) -> Any:
    """Numpy's numbers as Python's, tuples as lists, and None for what JSON cannot say (not finite
    numbers); for the files that people and other programs read."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
