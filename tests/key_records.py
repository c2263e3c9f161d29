# SPDX-License-Identifier: MIT
"""Records of keys, as tests of the manifest write and expect them."""

from __future__ import annotations

from pathlib import Path

from densify.dataset.manifest import KeyRecord, read_manifests
from densify.outputs.kitti_tree import FileRecord

DRIVE = "2011_09_26_drive_0013_sync"


def record(key: int, drive: str = DRIVE, **others) -> KeyRecord:
    files = {f"val/{drive}/{key:010d}.png": FileRecord.of(b"%d" % key)}
    fields = {"status": "done", "frames": tuple(range(key - 1, key + 2)), "files": files}
    return KeyRecord(drive, key, **{**fields, "scores": {"ghost": 0.5}, "seconds": 2.5, **others})


def write_lines(path: Path, *records: KeyRecord) -> bytes:
    data = b"".join(r.to_line() for r in records)
    path.write_bytes(data)
    return data


def write_files(root: Path, *records: KeyRecord) -> None:
    """What `record` says they hold."""
    for r in records:
        for name in r.files:
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(b"%d" % r.key)


def keys(root: Path) -> list[int]:
    return [key for _, key in read_manifests(root)]
