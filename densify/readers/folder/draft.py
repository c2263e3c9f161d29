# SPDX-License-Identifier: MIT
"""A first ``densify.yaml`` for a folder: what is found in it, and what only its owner knows left to
be filled in."""

from __future__ import annotations

from pathlib import Path

from densify.readers.decoded_files import image_size_px
from densify.readers.folder.columns import SweepColumns
from densify.readers.folder.config import SweepFiles
from densify.readers.folder.series import find_images, find_pose_file, in_time, sweep_folders
from densify.readers.point_fields import find_times
from densify.readers.point_files import read_table
from densify.readers.recorded_poses import PoseFile

_TEXT = """\
# What the files of this folder cannot say themselves; every key may be left out. Lines with a # in
# front are examples: take the # away where they are right.

sweeps:
{sweeps}
  # scale_m: 0.001       # metres of a unit of the points
  # axes: [z, -x, -y]    # which stored axes are x (forward), y (left) and z (up)
  # reference: start     # the stamp is the sweep's start, middle or end
  # compensated: true    # the vehicle's own motion in a sweep was taken out already
  # scanner_origins: [[0, 0, 0]]  # where rays start, metres, if not at 0 0 0

{poses}
#   inverse: true         # the file has world-to-lidar, not lidar-to-world
#   T_frame_lidar: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]  # if poses are another frame's

# Cameras: K and T_cam_lidar are to be filled in (p_cam = T_cam_lidar p_lidar; the camera looks
# along z, x to the right, y down). model: pinhole, fisheye or mei. stamps: names, a file, or sweeps
# (an image was exposed at the stamp of the sweep of its number).
# cameras:
"""
_CAMERA = """\
#   {name}:
#     files: {files}
#     size: [{width}, {height}]
#     model: pinhole
#     distortion: []
#     row_time_s: 0
#     K: [fx, fy, cx, cy]
#     T_cam_lidar: [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]
"""


def draft_config(folder: Path) -> str:
    """Return the text of a commented densify.yaml that opens as it is. Reads one sweep and one
    image of each folder. Raises InputError if there are no sweeps, or the first cannot be read."""
    path = find_pose_file(folder, "")
    poses = "# poses:\n#   file: poses.txt       # KITTI 3x4, 4x4, TUM, or a table"
    if path is not None:
        poses = f"poses:\n  file: {path.name}  # {PoseFile.read(path).form}"
    text = _TEXT.format(sweeps="\n".join(_sweep_lines(folder)), poses=poses)
    for files, images in find_images(folder).items():
        place = folder / files
        name = place.parent.name if place.name in ("data", "images") else place.name
        width, height = image_size_px(images[0])
        text += _CAMERA.format(name=name, files=files, width=width, height=height)
    return text


def _sweep_lines(folder: Path) -> list[str]:
    (choice, paths), *others = sweep_folders(folder).items()
    series = in_time(folder, paths, "", "")
    columns = read_table(next(iter(series.paths.values()))).columns
    either = f"or: {', '.join(name for name, _ in others)}" if others else f"{len(paths)} sweeps"
    lines, names = [f"  files: {choice}  # {either}"], list(columns)
    unknown = [name for name in columns if name.startswith("column")]
    for name in unknown:
        if "time" not in names and find_times(columns[name], name, 10**8, None)[0] is not None:
            names[names.index(name)] = "time"
    names = [f"unknown{i}" if name in unknown else name for i, name in enumerate(names)]
    if unknown:
        lines.append(f"  columns: [{', '.join(names)}]  # time by its values: check them")
    found = SweepColumns(series, SweepFiles(columns=tuple(names) if unknown else None), None).layout
    if found.fields.intensity:
        lines.append(f"  intensity: {found.fields.intensity}")
        lines.append(f"  intensity_scale: {found.intensity_scale:g}  # what full brightness is")
    if found.times is None:
        lines.append(f"  # time: NAME           # {found.time_words}")
    else:
        lines.append(f"  time: {found.times.field}")
        lines.append(f"  time_unit: {found.times.unit}  # a sweep takes about a period in it")
        lines.append(f"  time_is: {'absolute' if found.times.absolute else 'relative'}")
    if series.stamps_ns is None:
        lines.append("  rate_hz: 10  # assumed; or a file with a time a sweep: stamps: times.txt")
    else:
        lines.append(f"  # stamps are taken from {series.told_by}")
    return lines
