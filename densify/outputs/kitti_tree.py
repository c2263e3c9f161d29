# SPDX-License-Identifier: MIT
"""Write KITTI's folders: depth completion (training sets, exports), and tracking (exports).

Loaders of KITTI depth completion (Uhrig et al., "Sparsity Invariant CNNs", 3DV 2017) read
``SPLIT/DRIVE/proj_depth/KIND/CAMERA/0000000120.png``. KIND is velodyne_raw (single sweep) or
groundtruth. groundtruth_filled and confidence are additions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from densify.config.errors import InputError
from densify.depth.rays import corners_of, grow_box
from densify.geometry import cameras, poses
from densify.geometry.types import CameraView, DepthMap, Float, ObjectTrack
from densify.outputs.cloud_files import StoredCloud
from densify.outputs.depth_png import encode_png, map_path, write_confidence_png, write_depth_png
from densify.outputs.finished_run import FinishedRun
from densify.outputs.folders import drive_folder, plain, split_of, write_file, write_json
from densify.readers.decoded_files import decode_image
from densify.version import __version__

_KIND_OF = {"depth": "groundtruth", "depth_filled": "groundtruth_filled"}
_UNKNOWN = 3  # occluded: unknown
# Limits of the types: height and length of a car, width of a vehicle, length of a pedestrian
_TALL_M, _CAR_M, _WIDE_M, _WALKER_M = 2.2, 6.0, 1.4, 1.2
_ENDS = (("rear", "front"), ("right", "left"))  # sides of a box, by axis


def write_key(
    drive: Path, frame: int, sparse: Mapping[str, DepthMap], dense: Mapping[str, DepthMap]
) -> list[Path]:
    """Write the depth maps of one key sweep, and return the paths. Equal maps give equal bytes.

    Args:
        drive: Folder of the drive in the tree, SPLIT/DRIVE.
        frame: Frame number of the key sweep, the name of the files.
        sparse: Maps of the key sweep alone, by camera.
        dense: Maps of all sweeps, by camera.
    """
    written = []
    for camera, maps in dense.items():
        raw, measured, filled, confidence = (
            _map_path(drive, kind, camera, f"{frame:010d}")
            for kind in ("velodyne_raw", *_KIND_OF.values(), "confidence")
        )
        write_depth_png(raw, sparse[camera].depth_m)
        write_depth_png(measured, maps.depth_m)
        write_depth_png(filled, maps.filled_m)
        write_confidence_png(confidence, maps.confidence, maps.filled_m)
        written += [raw, measured, filled, confidence]
    return written


def _map_path(drive: Path, kind: str, camera: str, number: str) -> Path:
    return map_path(drive / "proj_depth" / kind, camera, number)


def write_kitti(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write a depth completion tree with images ``SPLIT/DRIVE/CAMERA/data/0000000120.png``.

    K is in ``intrinsics/CAMERA/0000000120.txt``. Recordings unknown to the benchmark are in train.
    files.txt has each map's image, measured and filled depth, annotations.json ``cam_in`` for
    Metric3D.
    """
    entries: list[dict[str, Any]] = []
    for run in runs:
        if not run.recording:
            raise InputError(f"{run.folder}/run.yaml: recording: expected the recording's name")
        drive = folder / split_of(run.recording) / drive_folder(run.recording)
        for map_name in run.chosen_maps:
            entries += _write_map(run, map_name, drive, folder)
    lines = [f"{entry['rgb']} {entry['depth']} {entry['depth_filled']}\n" for entry in entries]
    write_file(folder / "files.txt", "".join(lines).encode())
    write_json(folder / "annotations.json", {"files": entries})


def _write_map(run: FinishedRun, name: str, drive: Path, root: Path) -> list[dict[str, Any]]:
    """Write the files of a map and return its annotations.json entries, none without an image."""
    camera, _, number = name.partition("/")
    number, maps = number or f"{run.key:010d}", run.maps(name)
    paths = {kind: _map_path(drive, tree, camera, number) for kind, tree in _KIND_OF.items()}
    for kind, path in paths.items():
        write_file(path, encode_png(maps[kind]))
    write_file(_map_path(drive, "confidence", camera, number), encode_png(maps["confidence"]))
    single_sweep = map_path(run.folder / "scene", "none", name)
    if single_sweep.is_file():
        write_file(_map_path(drive, "velodyne_raw", camera, number), single_sweep.read_bytes())
    if name in run.scene.views:
        K = run.scene.views[name].camera.K
        text = " ".join(f"{value:.6f}" for value in K.ravel())
        write_file(map_path(drive / "intrinsics", camera, number, ".txt"), f"{text}\n".encode())
    if (jpeg := run.jpeg(name)) is None:
        return []
    image = map_path(drive / camera, "data", number)
    write_file(image, encode_png(decode_image(jpeg, name)))
    relative = {n: p.relative_to(root).as_posix() for n, p in {"rgb": image, **paths}.items()}
    cam_in = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return [{**relative, "cam_in": cam_in, "depth_scale": 256.0}]


_Objects = dict[int, ObjectTrack]
"""Number of an object over the sequence -> its track in one key."""


def write_kitti_tracking(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write labels, calibration, key sweeps (deskewed) and images of one camera.

    The labels are those of Geiger, Lenz, Urtasun, CVPR 2012. A sequence is a recording, a frame is
    a key. A box is where the key sweep measured the object, its type follows from the size.
    ``occluded`` is 3, unknown. ``truncated`` is 1 at the image's border.
    """
    for number, (_, sequence) in enumerate(groupby(runs, key=lambda run: run.folder.parent)):
        name, lines = f"{number:04d}", list[str]()
        for run, objects in _numbered(sequence):
            lines += _write_frame(run, objects, folder, name)
        write_file(folder / "label_02" / f"{name}.txt", "".join(lines).encode())


def _write_frame(run: FinishedRun, objects: _Objects, folder: Path, sequence: str) -> list[str]:
    """Write the files of a key in the sequence of this name, and return the key's label lines."""
    file, map_name = f"{run.key:06d}", run.chosen_maps[0]
    view = run.scene.views[map_name]
    if not view.camera.is_rectified:
        raise InputError(
            f"{map_name}: its images have distortion, and KITTI's are rectified; name a rectified "
            f"camera with --camera"
        )
    cloud = run.whole_cloud().sweep(run.key)
    table = np.column_stack([cloud.rigid_points, cloud.intensity]).astype("<f4")
    write_file(folder / "velodyne" / sequence / f"{file}.bin", table.tobytes())
    if (jpeg := run.jpeg(map_name)) is not None:
        image = encode_png(decode_image(jpeg, run.folder))
        write_file(folder / "image_02" / sequence / f"{file}.png", image)
    P = np.hstack([view.camera.K, np.zeros((3, 1))])  # of rectified camera 0 and image_02 too
    calibration = {f"P{n}": P for n in range(4)}
    calibration |= {"R_rect": np.eye(3), "Tr_velo_cam": view.camera.T_cam_lidar[:3]}
    calibration |= {"Tr_imu_velo": np.eye(4)[:3]}
    rows = (
        f"{name}: {' '.join(f'{x:.12e}' for x in values.ravel())}\n"
        for name, values in calibration.items()
    )
    write_file(folder / "calib" / f"{sequence}.txt", "".join(rows).encode())
    lines = []
    for number, track in objects.items():
        T_cam_object = view.camera.T_cam_lidar @ _measured_pose(track, run.key, cloud)
        if label := _label(track.size_m, T_cam_object, view):
            lines.append(f"{run.key} {number} {label}\n")
    return lines


def _measured_pose(track: ObjectTrack, key: int, cloud: StoredCloud) -> Float:
    """Return ``T_key_object`` (4,4) at the place where the key sweep, ``cloud``, measured it."""
    T_key_object = track.T_key_object[track.frames.index(key)].copy()
    of_track = cloud.moving & (cloud.instance == track.instance)
    if of_track.any():
        T_key_object[:3, 3] -= np.median(cloud.displacement[of_track], axis=0)
    return T_key_object


def _label(size_m: Float, T_cam_object: Float, view: CameraView) -> str:
    """Return type and values of an object's label line, or "" for an object out of view."""
    corners = poses.transform(T_cam_object, corners_of(size_m))
    if (corners[:, 2] < cameras.NEAREST_M).any():
        return ""
    uv = corners[:, :2] / corners[:, 2:] @ view.camera.K[:2, :2].T + view.camera.K[:2, 2]
    last_px = np.array([view.camera.width_px, view.camera.height_px]) - 1
    low, high = uv.min(axis=0), uv.max(axis=0)
    if (high <= 0).any() or (low >= last_px).any():
        return ""
    truncated = int((low < 0).any() or (high > last_px).any())
    x, y, z = T_cam_object[:3, 3]
    length_m, width_m, height_m = size_m
    turn_rad = -np.arctan2(T_cam_object[2, 0], T_cam_object[0, 0])
    # KITTI's alpha is the heading as seen from the camera, from -pi to pi.
    alpha_rad = (turn_rad - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
    box_px = [*np.clip(low, 0, last_px), *np.clip(high, 0, last_px)]
    bottom = [x, y + height_m / 2, z]
    values = [alpha_rad, *box_px, height_m, width_m, length_m, *bottom, turn_rad]
    text = " ".join(f"{value:.6f}" for value in values)
    return f"{_type_of(size_m)} {truncated} {_UNKNOWN} {text}"


def _type_of(size_m: Float) -> str:
    """Return KITTI's type for a box of (3,) length, width and height."""
    length_m, width_m, height_m = size_m
    if width_m < _WIDE_M:
        return "Pedestrian" if length_m < _WALKER_M else "Cyclist"
    return "Truck" if length_m > _CAR_M or height_m > _TALL_M else "Car"


def _numbered(runs: Iterable[FinishedRun]) -> list[tuple[FinishedRun, _Objects]]:
    """Return the objects of each key, with track numbers and sizes of the whole sequence."""
    keys = list[tuple[FinishedRun, _Objects]]()
    tracks_of: dict[int, list[ObjectTrack]] = {}
    for run in runs:
        earlier_numbers, objects = _earlier_numbers(run, keys), _Objects()
        for row, track in enumerate(run.tracks):
            number = earlier_numbers.get(row, len(tracks_of))
            objects[number] = track
            tracks_of.setdefault(number, []).append(track)
        keys.append((run, objects))
    return [
        (run, {number: _sized(track, tracks_of[number]) for number, track in objects.items()})
        for run, objects in keys
    ]


def _earlier_numbers(
    run: FinishedRun, keys: Sequence[tuple[FinishedRun, _Objects]]
) -> dict[int, int]:
    """Return index of a track of the run -> number of the same object in earlier keys."""
    candidates: list[tuple[float, int, int]] = []
    # Pairs of tracks nearer than half the smaller box are joined, the nearest pair first.
    for earlier_run, objects in keys:
        T_now, T_then = run.scene.T_key_lidar, earlier_run.scene.T_key_lidar
        shared = sorted(T_now.keys() & T_then.keys())
        if not shared:
            continue
        frame = shared[len(shared) // 2]  # about midway between the keys
        T_run_key = T_now[frame] @ poses.inverse(T_then[frame])
        for row, track in enumerate(run.tracks):
            for number, earlier in objects.items():
                distance_m = _distance_m(track, earlier, T_run_key)
                diagonal_m = min(float(np.hypot(*t.size_m[:2])) for t in (track, earlier))
                if distance_m < diagonal_m / 2:
                    candidates.append((distance_m, row, number))
    numbers = dict[int, int]()
    for _, row, number in sorted(candidates):
        if row not in numbers and number not in numbers.values():
            numbers[row] = number
    return numbers


def _distance_m(track: ObjectTrack, earlier: ObjectTrack, T_track_earlier: Float) -> float:
    """Return the median distance of two tracks in common sweeps, from above, inf for no sweep."""
    frames = sorted({*track.frames} & {*earlier.frames})
    if not frames:
        return np.inf
    centres, earlier_centres = (
        np.stack([t.T_key_object[t.frames.index(frame), :3, 3] for frame in frames])
        for t in (track, earlier)
    )
    offset = centres - poses.transform(T_track_earlier, earlier_centres)
    return float(np.median(np.linalg.norm(offset[:, :2], axis=1)))


def _sized(track: ObjectTrack, of_object: Sequence[ObjectTrack]) -> ObjectTrack:
    """Return a track with the length and width that its object has in all keys."""
    # The size is the median over keys that observed both ends, else that of the longest box. A side
    # that was observed keeps its position. Without such a side both ends grow by half.
    for axis, ends in enumerate(_ENDS):
        complete_m = [other.size_m[axis] for other in of_object if {*ends} <= {*other.sides_seen}]
        longest_m = max(float(other.size_m[axis]) for other in of_object)
        size_m = float(np.median(complete_m)) if complete_m else longest_m
        missing_m = size_m - track.size_m[axis]
        is_unseen = np.array([end not in track.sides_seen for end in ends])
        parts = is_unseen if is_unseen.sum() == 1 else np.array([0.5, 0.5])
        track = grow_box(track, axis, *(missing_m * parts))
    return track


def write_readme(root: Path, method: str, window: int, settings: Mapping[str, Any]) -> None:
    """Write ``README.txt`` with method, ``window`` (sweeps on each side of a key) and settings."""
    template = (files("densify.outputs") / "kitti_readme.txt").read_text("utf-8")
    text = template.format(
        version=__version__,
        method=method,
        window=window,
        sweeps=2 * window + 1,
        settings=yaml.safe_dump(plain(settings), sort_keys=False, allow_unicode=True).rstrip(),
    )
    write_file(root / "README.txt", text.encode())
