# SPDX-License-Identifier: MIT
"""Where moving objects were, as label lines of KITTI's tracking benchmark (Geiger et al., "Are we
ready for autonomous driving?", CVPR 2012): what scores trackers and draws boxes reads them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import Camera, Float, ObjectTrack
from densify.outputs.atomic import write_file
from densify.outputs.export.finished_run import FinishedRun

_CLASS = "Misc"  # what an object is nobody looked at
_OCCLUSION = 3  # unknown
_NEAREST_M = 0.1  # corners behind the camera have no pixel
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])


def write_export(run: FinishedRun, folder: Path) -> None:
    """``label/CAMERA.txt``, a line for each sweep and object that is on the camera's image, the
    camera taken where it stood at the sweep's reference time::

        frame track type truncated occluded alpha left top right bottom
        height width length x y z rotation_y

    type is Misc and occluded 3, unknown. left to bottom: of the box's corners, cut at the image.
    x y z: the middle of the box's underside, camera frame. Raises InputError where thresholds are
    given, which say nothing of objects.
    """
    run.check_no_thresholds("kitti-tracking")
    cameras = {view.camera.name: view.camera for view in run.chosen_views.values()}
    for name, camera in cameras.items():
        lines = []
        for track in run.tracks:
            for i, frame in enumerate(track.frames):
                T_key_lidar = run.scene.T_key_lidar.get(frame)
                if T_key_lidar is None:
                    continue
                T_cam_key = camera.T_cam_lidar @ poses.inverse(T_key_lidar)
                line = _line(camera, T_cam_key @ track.T_key_object[i], track)
                if line:
                    lines.append((frame, track.instance, line))
        text = "".join(f"{frame} {instance} {line}\n" for frame, instance, line in sorted(lines))
        path = folder / "label" / f"{name}.txt"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, text.encode())


def _line(camera: Camera, T_cam_object: Float, track: ObjectTrack) -> str:
    """Empty for what is not on the image."""
    corners = poses.transform(T_cam_object, _CORNERS * track.size_m)
    if corners[:, 2].min() < _NEAREST_M:
        return ""
    uv, _ = image_points(camera, corners)
    if np.isnan(uv).any():
        return ""
    low, high = uv.min(axis=0), uv.max(axis=0)
    last = np.array([camera.width_px - 1, camera.height_px - 1], float)
    left_top, right_bottom = np.clip(low, 0, last), np.clip(high, 0, last)
    shown = float(np.prod(right_bottom - left_top) / np.prod(high - low))
    if not shown > 0:
        return ""
    truncated = 0 if shown > 0.999 else 1 if shown > 0.5 else 2
    length_m, width_m, height_m = track.size_m
    place_m = poses.transform(T_cam_object, np.array([[0, 0, -height_m / 2]]))[0]
    forward = T_cam_object[:3, 0]
    rotation_y = -np.arctan2(forward[2], forward[0])
    alpha = _turned(rotation_y - np.arctan2(place_m[0], place_m[2]))
    numbers = [alpha, *left_top, *right_bottom, height_m, width_m, length_m, *place_m, rotation_y]
    written = " ".join(f"{number:.6f}" for number in numbers)
    return f"{_CLASS} {truncated} {_OCCLUSION} {written}"


def _turned(angle: float) -> float:
    """The same angle, -pi to pi."""
    return float(np.arctan2(np.sin(angle), np.cos(angle)))
