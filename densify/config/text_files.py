# SPDX-License-Identifier: MIT
"""Text, JSON and YAML. YAML's tags and aliases build nothing but plain values of bounded size."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from densify.config.errors import InputError
from densify.config.file_content import MOST_BYTES, read_bytes, reason

MOST_YAML_BYTES = 1 << 22
MOST_YAML_VALUES = 100_000


def read_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """The text of a file. Raises InputError if it is missing, unreadable, too large or no text."""
    try:
        return read_bytes(path, most_bytes).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: cannot be read: not a text file") from error


def read_json(path: Path) -> Any:
    """What a JSON file holds. Raises InputError if it is missing, unreadable or broken."""
    return parse_json(read_bytes(path), path)


def parse_json(data: bytes, where: Path | str) -> Any:
    """What a JSON text holds. Raises InputError, which begins with ``where``, if it is broken."""
    try:
        return json.loads(data, parse_int=_whole_number)
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{where}: not a whole JSON file ({reason(error)}); fetch it again"
        ) from error


def _whole_number(digits: str) -> int:
    """Raises ValueError for one that no float can be made of."""
    if len(digits) > 300:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)


def read_yaml(path: Path) -> tuple[Any, dict[str, int]]:
    """`parse_yaml` of a file."""
    return parse_yaml(read_text(path, MOST_YAML_BYTES), path)


def parse_yaml(text: str, where: Path | str) -> tuple[Any, dict[str, int]]:
    """What a YAML text holds, None if nothing, and the line of each key by its dotted name.

    Raises InputError, which begins with ``where``, if it is not YAML, has tags other than YAML's
    own, gives a key twice, is nested too deeply, or has more values than `MOST_YAML_VALUES` once
    its aliases are followed.
    """
    import yaml

    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            return None, {}
        lines: dict[str, int] = {}
        _count(root, {}, where)
        _note_lines(root, "", lines, where)
        return loader.construct_document(root), lines
    except InputError:
        raise
    except RecursionError as error:
        raise InputError(f"{where}: not YAML: nested too deeply") from error
    except Exception as error:  # a tag on what does not fit it raises anything
        raise InputError(f"{where}: not YAML: {reason(error)}") from error


def _count(node: Any, known: dict[int, int], where: Path | str) -> int:
    """Values in a node with all aliases followed; ``known``: those of nodes met before, 0 while
    they are open."""
    if known.get(id(node)) == 0:
        raise InputError(f"{where}: line {node.start_mark.line + 1}: an alias to what it is in")
    if id(node) not in known:
        known[id(node)] = 0
        parts = node.value if isinstance(node.value, list) else []
        flat = [n for part in parts for n in (part if isinstance(part, tuple) else (part,))]
        known[id(node)] = 1 + sum(_count(part, known, where) for part in flat)
        if known[id(node)] > MOST_YAML_VALUES:
            raise InputError(f"{where}: expected {MOST_YAML_VALUES:,} values at most, got more")
    return known[id(node)]


def _note_lines(node: Any, name: str, lines: dict[str, int], where: Path | str) -> None:
    if node.id != "mapping":
        return
    for key, value in node.value:
        full = f"{name}.{key.value}" if name else str(key.value)
        line = key.start_mark.line + 1
        if full in lines:
            raise InputError(f"{where}: line {line}: {full} is given twice; keep one")
        lines[full] = line
        _note_lines(value, full, lines, where)
