# SPDX-License-Identifier: MIT
"""Links by which loaders of others find a set in KITTI's tree, and its images::

    OUT/data_depth_velodyne/train, val     OUT/train, OUT/val; data_depth_annotated too
    OUT/data_rgb/val/2011_09_26_drive_0013_sync          the recording's folder, with
    OUT/data_rgb/2011_09_26/2011_09_26_drive_0013_sync   image_02/data/0000000120.png

fangchangma/self-supervised-depth-completion and its relatives use the first form,
JUGGHM/PENet_ICRA2021 the second (``--data-folder-rgb`` is OUT/data_rgb). Both take only drives
whose names end in ``_sync``.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from densify.config.errors import InputError, OutputError
from densify.dataset.plan import PlannedDrive
from densify.readers import open_sequence
from densify.readers.kitti.raw import KittiRaw

_log = logging.getLogger("densify")


def make_links(out: Path, drives: Sequence[PlannedDrive]) -> None:
    """Make the links that are missing. Warns of recordings that are no KITTI raw drives, because
    their images lie otherwise.

    Raises OutputError if one cannot be made, InputError if something else has its place.
    """
    for drive in drives:
        for place, target in _links(out, drive):
            if os.path.lexists(place):
                if place.is_symlink() and os.readlink(place) == target:
                    continue
                raise InputError(
                    f"--links: {place} is there already and leads elsewhere; expected nothing, or "
                    f"a link to {target}; move it away"
                )
            try:
                place.parent.mkdir(parents=True, exist_ok=True)
                os.symlink(target, place)
            except FileExistsError:  # a shard beside this one was faster
                pass
            except OSError as error:
                raise OutputError(
                    f"--links: {place} cannot be made: {error.strerror or error}"
                ) from error


def _links(out: Path, drive: PlannedDrive) -> Iterator[tuple[Path, str]]:
    """Yield the path and the target of each link."""
    split, name = drive.source.folder.split("/", 1)
    for product in ("data_depth_velodyne", "data_depth_annotated"):
        yield out / product / split, f"../{split}"
    sequence = open_sequence(drive.source.data)
    if not isinstance(sequence, KittiRaw):
        _log.warning("--links: %s is no KITTI raw drive: no links to its images", name)
        return
    folder = str(sequence.where.resolve())
    yield out / "data_rgb" / split / name, folder
    yield out / "data_rgb" / name[:10] / name, folder
