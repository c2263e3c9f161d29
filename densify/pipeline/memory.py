# SPDX-License-Identifier: MIT
"""How much memory a run takes, told before it starts, and how much there is."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from densify.config import Config
from densify.config.errors import ComputationError, InputError
from densify.geometry.types import LidarSequence
from densify.readers.timeline import choose_cameras

# Measured on streets: what is loaded; a point of the window, and around it; of one sweep, what
# comes from beyond the window; a pixel of an image.
_BASE_BYTES, _POINT_BYTES, _AROUND_BYTES, _FAR_BYTES, _PIXEL_BYTES = 0.55e9, 850, 90, 6000, 120
_USUAL_HZ = 10
_CERTAIN = 0.8  # of the need, which is rather too large than too small
_GROUPS = Path("/sys/fs/cgroup")


def check_fits(
    sequence: LidarSequence, key: int, window: int, cameras: Sequence[str] | None, config: Config
) -> None:
    """Raise InputError if a run of this key certainly takes more memory than there is. Parameters
    as of `need_of_run`."""
    try:
        need_bytes = need_of_run(sequence, key, window, cameras, config)
    except (InputError, ComputationError):  # whoever computes says it better
        return
    check_free(need_bytes, f"--window {window}: a run")


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
    """Return about how many bytes a process takes for one key at its peak.

    Reads the key's sweep. Parameters as of `densify.run`. Raises InputError for a sweep that cannot
    be read, and cameras that do not exist.
    """
    num_points, chosen = len(sequence[key]), choose_cameras(sequence, cameras)
    num_sweeps = min(2 * window + 1, len(sequence.frames))
    around_s = config.flow.around_s(_USUAL_HZ * num_points)
    num_around = min(2 * _USUAL_HZ * around_s, len(sequence.frames) - num_sweeps)
    far = config.accumulate.far_m > 0 and len(sequence.frames) > num_sweeps
    bytes_of_point = num_sweeps * _POINT_BYTES + num_around * _AROUND_BYTES + far * _FAR_BYTES
    num_pixels = sum(camera.width_px * camera.height_px for camera in chosen)
    return _BASE_BYTES + num_points * bytes_of_point + num_pixels * _PIXEL_BYTES


def available_bytes() -> float | None:
    """Return the memory that this process may still take: what the machine has free, and what the
    limits of its control groups (version 2) leave; None where nothing tells."""
    found = [1024.0 * kb for kb in _table(Path("/proc/meminfo"), "MemAvailable")]
    for group in _own_groups():
        with suppress(OSError, ValueError):  # no limit is the word max
            most = int((group / "memory.max").read_text())
            used = int((group / "memory.current").read_text())
            stat = group / "memory.stat"  # files that are kept in memory can go
            files = sum(_table(stat, "inactive_file") + _table(stat, "active_file"))
            found.append(float(max(0, most - used + files)))
    return min(found, default=None)


def _own_groups() -> list[Path]:
    """Return the folder of this process's control group, and those above it."""
    with suppress(OSError):
        names = re.findall(r"^0::/(.*)$", Path("/proc/self/cgroup").read_text(), re.MULTILINE)
        own = _GROUPS.joinpath(*names)
        return [group for group in (own, *own.parents) if group.is_relative_to(_GROUPS)]
    return []


def _table(path: Path, name: str) -> list[int]:
    """Return the number of a row of a table of the system, if there is one."""
    with suppress(OSError):
        return [int(n) for n in re.findall(rf"^{name}:?\s+(\d+)", path.read_text(), re.MULTILINE)]
    return []
