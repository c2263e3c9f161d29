# SPDX-License-Identifier: MIT
"""Write depth maps as a KITTI depth tree (Uhrig et al., "Sparsity Invariant CNNs", 3DV 2017).

Loaders of KITTI depth completion read ``SPLIT/DRIVE/proj_depth/KIND/CAMERA/0000000120.png``. KIND
is velodyne_raw (single sweep) or groundtruth. groundtruth_filled and confidence are additions.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import yaml

from densify.geometry.types import DepthMap
from densify.outputs.atomic import plain, write_file
from densify.outputs.depth_png import write_confidence_png, write_depth_png
from densify.version import __version__

Split = Literal["train", "val"]

README = "README.txt"


@dataclass(frozen=True)
class FileRecord:
    """The expected size of a file in bytes and its hexadecimal SHA-256."""

    num_bytes: int
    sha256: str

    @staticmethod
    def of(data: bytes) -> FileRecord:
        """Return the record of a file with this content."""
        return FileRecord(len(data), hashlib.sha256(data).hexdigest())


_VALIDATION = {
    *(f"2011_09_26_drive_{n:04d}" for n in (2, 5, 13, 20, 23, 36, 79, 95, 113)),
    *("2011_09_28_drive_0037", "2011_09_29_drive_0026", "2011_09_30_drive_0016"),
    "2011_10_03_drive_0047",
}
_KITTI_DRIVE = re.compile(r"(\d{4}_\d\d_\d\d_drive_\d{4})(?:_sync|_extract)?", re.ASCII)
_PUNCTUATION = str.maketrans({":": "-", "?": "_", "=": "-", "&": "_"})
_DEFAULT_STREET = "street:street?seed=0&sensor=hdl64"
_FOLDER_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")


def split_of(drive: str) -> Split:
    """Return "val" for the 13 validation drives of KITTI's depth benchmark, else "train"."""
    match = _KITTI_DRIVE.fullmatch(drive)
    return "val" if match and match[1] in _VALIDATION else "train"


def drive_folder(name: str) -> str:
    """Return a valid, unique folder name. A valid name, such as KITTI's names, is kept."""
    # street:highway?seed=0&sensor=hdl64 -> street-highway_seed-0_sensor-hdl64
    if name == _DEFAULT_STREET:
        return "street"
    folder = name.translate(_PUNCTUATION)
    if _FOLDER_NAME.fullmatch(folder):
        return folder
    readable = re.sub(r"[^A-Za-z0-9_.]+", "-", folder)[:80].strip(".-") or "drive"
    return f"{readable}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def write_key(
    root: Path,
    folder: str,
    frame: int,
    sparse: Mapping[str, DepthMap],
    dense: Mapping[str, DepthMap],
) -> dict[str, FileRecord]:
    """Write the depth maps of one key sweep, and return path in the tree -> size and hash.

    ``folder`` is the drive's, ``val/2011_09_26_drive_0013_sync``. ``sparse`` has the maps of the
    key sweep alone, ``dense`` those of all sweeps, by camera. Equal maps give equal bytes.
    """
    paths = []
    for camera, maps in dense.items():
        raw, measured, filled, confidence = (
            root / folder / "proj_depth" / product / camera / f"{frame:010d}.png"
            for product in ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")
        )
        write_depth_png(raw, sparse[camera].depth_m)
        write_depth_png(measured, maps.depth_m)
        write_depth_png(filled, maps.filled_m)
        write_confidence_png(confidence, maps.confidence, maps.filled_m)
        paths += [raw, measured, filled, confidence]
    return {p.relative_to(root).as_posix(): FileRecord.of(p.read_bytes()) for p in paths}


def write_readme(root: Path, method: str, window: int, settings: Mapping[str, Any]) -> None:
    """Write ``README.txt``, which describes the files beside it and how they were made."""
    text = _README.format(
        version=__version__,
        method=method,
        window=window,
        sweeps=2 * window + 1,
        settings=yaml.safe_dump(plain(settings), sort_keys=False, allow_unicode=True).rstrip(),
    )
    write_file(root / README, text.encode())


_README = """\
Depth maps for training, made by densify {version}
{method}, window {window}: each moment from up to {sweeps} lidar sweeps

The folders and files are those of KITTI's depth completion benchmark, whose loaders read them:

  <train|val>/<drive>/proj_depth/<product>/<camera>/<frame, 10 digits>.png

  velodyne_raw        input: depth of the sweep of that frame alone
  groundtruth         target: depth measured by all the sweeps. Method flow moves moving points to
                      the exposure; icp leaves them where they were measured
  groundtruth_filled  groundtruth, and pixels interpolated between measured ones
  confidence          of groundtruth_filled, and so of groundtruth too

val holds KITTI's 13 validation drives, train every other recording.

Depth is a 16-bit gray PNG, metres along the camera's optical axis, 0 is none:
depth_m = cv2.imread(path, cv2.IMREAD_UNCHANGED) / 256.0. Confidence is an 8-bit gray PNG: 255 is
most certain, 0 is no depth. With c = (value - 1) / 254, one pixel in 10^(5 c) is expected to be
wrong by KITTI's rule: more than 3 px of disparity and 5 %.

All maps show the moment in which their own image was exposed (the middle of the sweep, where the
settings say "at: sweep"). velodyne_raw is densify's own projection and differs from KITTI's files.

The images stay with the recordings, whose licences go on holding for the maps. KITTI is CC BY-NC-SA
3.0: name its authors, no commercial use, share alike. dataset.json says which recordings these are,
and has the cameras' calibration. manifest.jsonl (or manifest-1of4.jsonl and so on) has one line for
every key: whether it is here, is missing and why, and size and SHA-256 of its files.

Settings:

{settings}
"""
