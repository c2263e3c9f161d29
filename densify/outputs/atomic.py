# SPDX-License-Identifier: MIT
"""Files and folders that appear only when they are complete: written aside, under a hidden name in
the same folder (so on the same file system), then renamed.

What is aside says whose it is, ``.NAME.MACHINE.PID-START.tmp``: several machines may share a
folder, process numbers come again, and a killed process cannot tidy up (`clear_leftovers`).
"""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import re
import shutil
import socket
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

log = logging.getLogger("densify")

_ASIDE = re.compile(
    r"\.(?P<name>.+)\.(?P<machine>[\w-]+)\.(?P<pid>\d+)-(?P<start>\d+)\.(?P<kind>tmp|old)", re.ASCII
)
_CANNOT_SYNC_FOLDERS = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)


@dataclass(frozen=True)
class FileRecord:
    """What a file must hold. sha256: of the content, hexadecimal."""

    num_bytes: int
    sha256: str

    @staticmethod
    def of(data: bytes) -> FileRecord:
        return FileRecord(len(data), hashlib.sha256(data).hexdigest())


def write_file(path: Path, data: bytes, durable: bool = False) -> None:
    """Write or replace a file; on any failure the old one stays and nothing is left aside.

    durable: the file is on the disk when this returns, and after a power loss in the middle it is
        the old one or the new one, never an empty one. Costs milliseconds; inside `staged_folder`,
        which sees to that itself, it is not needed.
    """
    aside = _aside(path, "tmp")
    try:
        with aside.open("wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise
    if durable:
        sync_folder(path.parent)


@contextmanager
def file_aside(path: Path) -> Iterator[Path]:
    """A place to write a large file to, which becomes ``path`` when the block ends without an
    exception; on any exception nothing is left, and an old file stays."""
    aside = _aside(path, "tmp")
    try:
        yield aside
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where missing; they are on the disk when this returns."""
    missing = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for place in missing:
        sync_folder(place.parent)


def sync_folder(folder: Path) -> None:
    """Put the names in a folder on the disk, where its file system can be asked to."""
    try:
        _sync(folder)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC_FOLDERS:
            raise


@contextmanager
def staged_folder(folder: Path, owned: Collection[str]) -> Iterator[Path]:
    """A folder to write into that becomes ``folder`` when the block ends without an exception.

    owned: names of entries that belong to the writer. Where ``folder`` exists already, these are
        replaced or vanish; every other entry is kept. Where ``folder`` is a link, the folder it
        leads to is replaced and the link stays. On any exception, an interrupt included,
        ``folder`` and the folders above it are as they were before. Warns where the replaced
        folder cannot be removed.

    Everything in it is on the disk before it gets its name.
    """
    folder = Path(os.path.realpath(folder))
    parent = folder.parent
    missing = [place for place in (parent, *parent.parents) if not place.exists()]
    staging = _aside(folder, "tmp")
    try:
        make_folder(parent)
        if staging.exists():  # could not be removed after an earlier failure
            shutil.rmtree(staging)
        staging.mkdir()
        yield staging
        if folder.exists():
            _keep_others(folder, staging, owned)
            _sync_tree(staging)
            _swap(staging, folder)
        else:
            _sync_tree(staging)
            os.rename(staging, folder)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        for place in missing:  # from the deepest up
            if place.exists() and not any(place.iterdir()):
                place.rmdir()
        raise
    sync_folder(parent)


def clear_leftovers(root: Path) -> list[Path]:
    """Remove what killed processes of this machine left aside anywhere under a folder.

    A folder that was being replaced when its writer was killed gets its old content back. Whatever
    other machines or living processes have aside stays. Returns what was cleared away; warns of
    what could not be.
    """
    cleared = []
    for place, folders, files in os.walk(root):
        found = [match for name in (*folders, *files) if (match := _ASIDE.fullmatch(name))]
        asides = {match[0] for match in found}
        folders[:] = [name for name in folders if name not in asides]
        for match in found:
            aside = Path(place, match[0])
            if match["machine"] != _machine() or _is_alive(int(match["pid"]), match["start"]):
                continue
            try:
                _clear(aside, Path(place, match["name"]), match["kind"])
                cleared.append(aside)
            except OSError as error:
                log.warning(
                    "%s: left by a killed run, cannot be removed: %s; remove it by hand",
                    aside,
                    error.strerror or error,
                )
    return cleared


def _clear(aside: Path, path: Path, kind: str) -> None:
    if kind == "old" and not path.exists():  # killed between the two renames of _swap
        os.rename(aside, path)
    elif aside.is_dir() and not aside.is_symlink():
        shutil.rmtree(aside)
    else:
        aside.unlink()


def _aside(path: Path, kind: str) -> Path:
    return path.with_name(f".{path.name}.{_machine()}.{_process(os.getpid())}.{kind}")


@lru_cache(maxsize=1)
def _machine() -> str:
    """Where a process number means the same process. Containers with one host name have their
    own numbers, so the number space is part of it."""
    try:
        numbers = re.sub(r"\D", "", os.readlink("/proc/self/ns/pid"))
    except OSError:  # not Linux
        numbers = "0"
    return f"{re.sub(r'[^A-Za-z0-9]', '-', socket.gethostname())}-{numbers}"


@lru_cache(maxsize=1)
def _process(pid: int) -> str:
    return f"{pid}-{_start(pid) or 0}"


def _start(pid: int) -> str | None:
    """Clock ticks from the machine's to the process's start; empty for one that has ended but was
    not waited for, None where it cannot be known."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return None
    fields = stat.rpartition(b")")[2].split()  # the program's name may hold anything
    return "" if fields[0] in (b"Z", b"X") else fields[19].decode()


def _is_alive(pid: int, start: str) -> bool:
    found = _start(pid)
    if found is not None:
        return found == start
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return True


def _sync(path: Path | str) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _sync_tree(root: Path) -> None:
    for place, _, files in os.walk(root):
        for name in files:
            if not os.path.islink(os.path.join(place, name)):
                _sync(os.path.join(place, name))
        sync_folder(Path(place))


def _keep_others(folder: Path, staging: Path, owned: Collection[str]) -> None:
    for entry in sorted(folder.iterdir()):
        if entry.name in owned:
            continue
        if entry.is_dir() and not entry.is_symlink():
            shutil.copytree(entry, staging / entry.name, symlinks=True)
        else:
            shutil.copy2(entry, staging / entry.name, follow_symlinks=False)


def _swap(staging: Path, folder: Path) -> None:
    old = _aside(folder, "old")
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
