# SPDX-License-Identifier: MIT
"""How much memory a run takes, told before it starts. `densify bench memory` measures how well."""

from __future__ import annotations

import re
import resource
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

from densify.config import Config
from densify.config.errors import ComputationError, InputError
from densify.geometry.types import LidarSequence
from densify.readers.window import choose_cameras

# Measured on streets: what is loaded; a point of the window, and around it; of one sweep, what
# comes from beyond the window; a pixel of an image.
_BASE_BYTES, _POINT_BYTES, _AROUND_BYTES, _FAR_BYTES, _PIXEL_BYTES = 0.55e9, 850, 90, 6000, 120
_USUAL_HZ = 10
_CERTAIN = 0.8  # of the need, which is told a little too large rather than too small
_GROUPS = Path("/sys/fs/cgroup")


def check_fits(
    sequence: LidarSequence, key: int, window: int, cameras: Sequence[str] | None, config: Config
) -> None:
    """Raise InputError if a run of this key certainly takes more memory than there is. Parameters
    as of `need_of_run`."""
    try:
        need = need_of_run(sequence, key, window, cameras, config)
    except (InputError, ComputationError):  # whoever computes says it better
        return
    check_free(need, f"--window {window}: a run")


def check_free(need_bytes: float, who: str) -> None:
    """Raise InputError if that is certainly more than `available_bytes`. who: takes it."""
    free_bytes = available_bytes()
    if free_bytes is not None and _CERTAIN * need_bytes > free_bytes:
        raise InputError(
            f"{who} takes about {need_bytes / 1e9:.1f} GB of memory here, and "
            f"{free_bytes / 1e9:.1f} GB are free; try a smaller --window, one --camera or "
            f"--set accumulate.far_m=0"
        )


def need_of_run(
    sequence: LidarSequence, key: int, window: int, cameras: Sequence[str] | None, config: Config
) -> float:
    """About how many bytes a process takes for one key at its peak.

    Reads the key's sweep. Parameters as of `densify.run`. Raises InputError for a sweep that cannot
    be read, and cameras that do not exist.
    """
    num_points, chosen = len(sequence[key]), choose_cameras(sequence, cameras)
    num_sweeps = min(2 * window + 1, len(sequence.frames))
    around_s = config.flow.around_s(_USUAL_HZ * num_points)
    num_around = min(2 * _USUAL_HZ * around_s, len(sequence.frames) - num_sweeps)
    far = config.accumulate.far_m > 0 and len(sequence.frames) > num_sweeps
    bytes_of_point = num_sweeps * _POINT_BYTES + num_around * _AROUND_BYTES + far * _FAR_BYTES
    return (
        _BASE_BYTES
        + num_points * bytes_of_point
        + sum(camera.width_px * camera.height_px for camera in chosen) * _PIXEL_BYTES
    )


def available_bytes() -> float | None:
    """Memory that this process may still take: what the machine has free, and the limits of its
    control group and of ulimit leave; None where nothing tells."""
    return min([*_of_machine(), *_of_group(), *_of_limits()], default=None)


def _of_machine() -> Iterator[float]:
    yield from (1024.0 * kb for kb in _table(Path("/proc/meminfo"), "MemAvailable"))


def _of_group() -> Iterator[float]:
    """Version 2 of control groups; files that are kept in memory can go."""
    own = _own_group()
    for group in (own, *own.parents):
        if _GROUPS not in (group, *group.parents):
            return
        with suppress(OSError, ValueError):  # no limit is the word max
            most = int((group / "memory.max").read_text())
            used = int((group / "memory.current").read_text())
            stat = group / "memory.stat"
            files = sum(_table(stat, "inactive_file") + _table(stat, "active_file"))
            yield float(max(0, most - used + files))


def _own_group() -> Path:
    with suppress(OSError):
        found = re.search(r"^0::/(.*)$", Path("/proc/self/cgroup").read_text(), re.MULTILINE)
        if found:
            return _GROUPS / found[1]
    return _GROUPS


def _of_limits() -> Iterator[float]:
    for limit, size in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
        most = resource.getrlimit(limit)[0]
        if most != resource.RLIM_INFINITY:
            used = 1024 * sum(_table(Path("/proc/self/status"), size))
            yield float(max(0, most - used))


def _table(path: Path, name: str) -> list[int]:
    """The number of a row of a table of the system, if there is one."""
    with suppress(OSError):
        found = re.search(rf"^{name}:?\s+(\d+)", path.read_text(), re.MULTILINE)
        return [int(found[1])] if found else []
    return []
