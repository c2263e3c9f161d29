# SPDX-License-Identifier: MIT
"""Files and folders that appear only when they are complete: written aside, under a hidden name in
the same folder (so on the same file system), then renamed.
"""

from __future__ import annotations

import logging
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

log = logging.getLogger("densify")


def write_file(path: Path, data: bytes) -> None:
    """Write or replace a file; on any failure the old one stays and nothing is left aside."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        aside.write_bytes(data)
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


@contextmanager
def staged_folder(folder: Path, owned: Collection[str]) -> Iterator[Path]:
    """A folder to write into that becomes ``folder`` when the block ends without an exception.

    owned: names of entries that belong to the writer. Where ``folder`` exists already, these are
        replaced or vanish; every other entry is kept. Where ``folder`` is a link, the folder it
        leads to is replaced and the link stays. On any exception, an interrupt included,
        ``folder`` and the folders above it are as they were before. Warns where the replaced
        folder cannot be removed.
    """
    folder = Path(os.path.realpath(folder))
    parent = folder.parent
    missing = [place for place in (parent, *parent.parents) if not place.exists()]
    staging = parent / f".{folder.name}.{os.getpid()}.tmp"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        if staging.exists():  # left by a killed process of the same number
            shutil.rmtree(staging)
        staging.mkdir()
        yield staging
        if folder.exists():
            _keep_others(folder, staging, owned)
            _swap(staging, folder)
        else:
            os.rename(staging, folder)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        for place in missing:  # from the deepest up
            if place.exists() and not any(place.iterdir()):
                place.rmdir()
        raise


def _keep_others(folder: Path, staging: Path, owned: Collection[str]) -> None:
    for entry in sorted(folder.iterdir()):
        if entry.name in owned:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, staging / entry.name, symlinks=True)
        else:
            shutil.copy2(entry, staging / entry.name, follow_symlinks=False)


def _swap(staging: Path, folder: Path) -> None:
    old = folder.with_name(f".{folder.name}.{os.getpid()}.old")
    try:
        os.rename(folder, old)
        os.rename(staging, folder)
    except BaseException:
        if old.exists() and not folder.exists():
            os.rename(old, folder)
        raise
    finally:
        if old.exists() and folder.exists():
            _remove_replaced(old)


def _remove_replaced(old: Path) -> None:
    try:
        shutil.rmtree(old)
    except OSError as error:  # the new folder is in place all the same
        log.warning(
            "%s: the replaced result cannot be removed: %s; remove it by hand",
            old,
            error.strerror or error,
        )
