# SPDX-License-Identifier: MIT
"""Write boxes and tracks as KITTI tracking labels (Geiger, Lenz, Urtasun, CVPR 2012)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import numpy as np

from densify.config.errors import InputError
from densify.depth.rays import corners_of, grown
from densify.geometry import cameras, poses
from densify.geometry.types import CameraView, Float, ObjectTrack
from densify.outputs.atomic import write_file
from densify.outputs.cloud_laz import StoredCloud
from densify.outputs.depth_png import encode_png
from densify.outputs.export.finished_run import FinishedRun
from densify.readers.decoded_files import decode_image

_UNKNOWN = 3  # occluded: unknown
_TALL_M, _CAR_M, _WIDE_M, _WALKER_M = 2.2, 6.0, 1.4, 1.2
_ENDS = (("rear", "front"), ("right", "left"))


class _Labelled(NamedTuple):
    """The objects of one key. numbers: their track numbers over the sequence."""

    run: FinishedRun
    tracks: list[ObjectTrack]
    numbers: list[int]


def write_kitti_tracking(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write labels, calibration, key sweeps (deskewed) and images of one camera.

    `densify.readers.kitti.tracking` reads the tree. A sequence is a recording, a frame is a key. A
    box is where the key sweep measured the object. Its type follows from the size. ``occluded`` is
    3, unknown. ``truncated`` is 1 at the image's border. Objects out of view are left out.
    """
    for number, (_, together) in enumerate(groupby(runs, key=lambda run: run.folder.parent)):
        name, lines = f"{number:04d}", list[str]()
        for key in _numbered(list(together)):
            lines += _write_key(key, folder, name)
        write_file(folder / "label_02" / f"{name}.txt", "".join(lines).encode())


def _write_key(labelled: _Labelled, folder: Path, name: str) -> list[str]:
    """Write the files of a key, and return its label lines. name: name of the sequence."""
    run, file = labelled.run, f"{labelled.run.key:06d}"
    view_name, view = _view(run)
    cloud = StoredCloud.joined([run.cloud(), *run.mover_clouds()])
    cloud = cloud.select((cloud.frame == run.key) & ~cloud.far)
    table = np.column_stack([cloud.rigid_points, cloud.intensity]).astype("<f4")
    write_file(folder / "velodyne" / name / f"{file}.bin", table.tobytes())
    jpeg = run.jpeg(view_name)
    if jpeg is not None:
        image = decode_image(jpeg, run.folder)
        write_file(folder / "image_02" / name / f"{file}.png", encode_png(image))
    write_file(folder / "calib" / f"{name}.txt", _calibration(view).encode())
    pairs = zip(labelled.tracks, labelled.numbers, strict=True)
    lines = (_line(track, number, run, view, cloud) for track, number in pairs)
    return [line for line in lines if line]


def _view(run: FinishedRun) -> tuple[str, CameraView]:
    """Return the name and the camera of the first chosen map."""
    name = run.cameras[0]
    view = run.views[name]
    if not view.camera.is_rectified:
        raise InputError(
            f"{name}: its images have distortion, and KITTI's are rectified; name a rectified "
            f"camera with --camera"
        )
    return name, view


def _calibration(view: CameraView) -> str:
    """Return the calibration file of a camera, which is rectified camera 0 and image_02 too."""
    P = np.hstack([view.camera.K, np.zeros((3, 1))])
    entries = {f"P{n}": P for n in range(4)}
    entries |= {"R_rect": np.eye(3), "Tr_velo_cam": view.camera.T_cam_lidar[:3]}
    entries |= {"Tr_imu_velo": np.eye(4)[:3]}
    return "".join(
        f"{name}: {' '.join(f'{x:.12e}' for x in np.ravel(values))}\n"
        for name, values in entries.items()
    )


def _line(
    track: ObjectTrack, number: int, run: FinishedRun, view: CameraView, cloud: StoredCloud
) -> str:
    """Return the label line of an object by the key sweep's points, "" if it is out of view."""
    mine = cloud.moving & (cloud.instance == track.instance)
    late_m = -np.median(cloud.displacement[mine], axis=0) if mine.any() else np.zeros(3)
    T_key_object = track.T_key_object[track.frames.index(run.key)].copy()
    T_key_object[:3, 3] += late_m
    T_cam_object = view.camera.T_cam_lidar @ T_key_object
    corners = poses.transform(T_cam_object, corners_of(track.size_m))
    if (corners[:, 2] < cameras.NEAREST_M).any():
        return ""
    uv = corners[:, :2] / corners[:, 2:] @ view.camera.K[:2, :2].T + view.camera.K[:2, 2]
    last_px = np.array([view.camera.width_px, view.camera.height_px]) - 1
    low, high = uv.min(axis=0), uv.max(axis=0)
    if (high <= 0).any() or (low >= last_px).any():
        return ""
    truncated = int((low < 0).any() or (high > last_px).any())
    x, y, z = T_cam_object[:3, 3]
    length_m, width_m, height_m = track.size_m
    turn = -np.arctan2(T_cam_object[2, 0], T_cam_object[0, 0])
    alpha = (turn - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
    bottom = np.array([x, y + height_m / 2, z])
    box_px = [*np.clip(low, 0, last_px), *np.clip(high, 0, last_px)]
    values = [alpha, *box_px, height_m, width_m, length_m, *bottom, turn]
    shown = " ".join(f"{value:.6f}" for value in values)
    return f"{run.key} {number} {_kind(track.size_m)} {truncated} {_UNKNOWN} {shown}\n"


def _kind(size_m: Float) -> str:
    """Return KITTI's type for a box of (3,) length, width and height."""
    length_m, width_m, height_m = size_m
    if width_m < _WIDE_M:
        return "Pedestrian" if length_m < _WALKER_M else "Cyclist"
    return "Truck" if length_m > _CAR_M or height_m > _TALL_M else "Car"


def _numbered(runs: Sequence[FinishedRun]) -> list[_Labelled]:
    """Return the objects of each key, with track numbers and sizes of the whole sequence."""
    keys = list[_Labelled]()
    for run in runs:
        numbers = _found_again(run, keys)
        first = 1 + max((n for key in keys for n in key.numbers), default=-1)
        fresh = iter(range(first, first + len(run.tracks)))
        own = [next(fresh) if number is None else number for number in numbers]
        keys.append(_Labelled(run, list(run.tracks), own))
    of_number: dict[int, list[ObjectTrack]] = {}
    for key in keys:
        for track, number in zip(key.tracks, key.numbers, strict=True):
            of_number.setdefault(number, []).append(track)
    return [
        key._replace(
            tracks=[
                _sized(track, of_number[number])
                for track, number in zip(key.tracks, key.numbers, strict=True)
            ]
        )
        for key in keys
    ]


def _found_again(run: FinishedRun, keys: Sequence[_Labelled]) -> list[int | None]:
    """Return for each track of a run the number it has in earlier keys, None for a new one."""
    away: list[tuple[float, int, int]] = []
    for key in keys:  # tracks must overlap in time and space
        shared = sorted(run.scene.T_key_lidar.keys() & key.run.scene.T_key_lidar.keys())
        if not shared:
            continue
        frame = shared[len(shared) // 2]
        T_run_key = run.scene.T_key_lidar[frame] @ poses.inverse(key.run.scene.T_key_lidar[frame])
        for i, track in enumerate(run.tracks):
            for other, number in zip(key.tracks, key.numbers, strict=True):
                away_m = _apart_m(track, other, T_run_key)
                least_m = min(float(np.hypot(*t.size_m[:2])) for t in (track, other))
                if away_m < least_m / 2:
                    away.append((away_m, i, number))
    numbers: list[int | None] = [None] * len(run.tracks)
    for _, i, number in sorted(away):
        if numbers[i] is None and number not in numbers:
            numbers[i] = number
    return numbers


def _apart_m(track: ObjectTrack, other: ObjectTrack, T_track_other: Float) -> float:
    """Return the median distance seen from above of two tracks in common sweeps, inf for none."""
    frames = sorted({*track.frames} & {*other.frames})
    if not frames:
        return np.inf
    here = np.stack([track.T_key_object[track.frames.index(f), :3, 3] for f in frames])
    there = np.stack([other.T_key_object[other.frames.index(f), :3, 3] for f in frames])
    off = here - poses.transform(T_track_other, there)
    return float(np.median(np.linalg.norm(off[:, :2], axis=1)))


def _sized(track: ObjectTrack, every: Sequence[ObjectTrack]) -> ObjectTrack:
    """Return a track with the length and width that its object has in all keys (``every``)."""
    # Keys that saw both ends count, else the longest box. A side that was seen keeps its place.
    for axis, ends in enumerate(_ENDS):
        whole = [t for t in every if {*ends} <= {*t.sides_seen}]
        size_m = (
            float(np.median([t.size_m[axis] for t in whole]))
            if whole
            else max(float(t.size_m[axis]) for t in every)
        )
        more_m = size_m - track.size_m[axis]
        before, after = (end not in track.sides_seen for end in ends)
        if before == after:
            track = grown(track, axis, more_m / 2, more_m / 2)
        else:
            track = grown(track, axis, more_m * before, more_m * after)
    return track
