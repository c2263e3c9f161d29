# SPDX-License-Identifier: MIT
"""The output of what belongs to a key beside its maps: ``scene``, for pages, viewers and other
tools.

::

    scene/image/CAMERA.jpg             the image that the map shows
    scene/none/CAMERA.png, icp/…       measured depth of the simpler methods, as in ``depth``
    scene/truth/CAMERA.png             true depth where there is some, as in ``depth``
    scene/sweep/CAMERA.png             16 bit: of measured pixels 1 + place of the source sweep in
                                       ``sweeps`` of scene.json; 0 none
    scene/reason/CAMERA.png            8 bit `densify.types.Reason` why a pixel's nearest point was
                                       left out (``output.rejected``)
    scene/scene.json                   key, and
      sweeps    of the window and beyond it: frame, since_key_s, far, and of the window's
                T_key_lidar (4,4)
      views     map -> the camera (width_px, height_px, K, model, distortion, ...), T_cam_key (4,4)
                when it shows the scene, late_s after the key, number of its image
      movers    moving objects: instance, num_points, and in key coordinates at the key's time
                centre_m, size_m along the axes, velocity_m_s, and path: where the centre was at
                each sweep that saw it (frame, since_key_s, position_m)
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.outputs.depth_png import write_depth_png
from densify.outputs.plain import write_json
from densify.outputs.png import encode_jpeg, encode_png
from densify.types import Camera, CameraView, Cloud, Result

SCHEMA_VERSION = 1
_LEAST_POINTS = 20  # fewer say nothing of an object's place
_SIZE_PERCENTILES = (2, 98)


def write_output(result: Result, context: Context, folder: Path) -> None:
    """See the module; nothing for results that know no poses."""
    if not result.T_key_lidar:
        return
    place = folder / "scene"
    sweeps = _sweeps(result)
    row_of = {sweep["frame"]: row for row, sweep in enumerate(sweeps)}
    for name, maps in result.depth.items():
        if name in context.images:
            write_file(_made(place, "image", name, "jpg"), encode_jpeg(context.images[name]))
        for method, baseline in result.baselines.items():
            write_depth_png(_made(place, method, name, "png"), baseline.depth[name].depth_m)
        if name in result.truth_m:
            write_depth_png(_made(place, "truth", name, "png"), result.truth_m[name])
        lookup = np.zeros(max(row_of) + 2, np.uint16)
        lookup[[*row_of]] = 1 + np.arange(len(row_of))
        write_file(_made(place, "sweep", name, "png"), encode_png(lookup[maps.frame]))
        if name in result.rejected:
            write_file(_made(place, "reason", name, "png"), encode_png(result.rejected[name]))
    table = {
        "schema_version": SCHEMA_VERSION,
        "key": result.key,
        "sweeps": sweeps,
        "views": {name: _view(view) for name, view in result.views.items()},
        "movers": _movers(result),
    }
    place.mkdir(exist_ok=True)
    write_json(place / "scene.json", table)


def _made(place: Path, kind: str, name: str, suffix: str) -> Path:
    path = place / kind / f"{name}.{suffix}"
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _sweeps(result: Result) -> list[dict[str, Any]]:
    """All sweeps that the cloud has points of, and those of the window, by frame."""
    frames, rows = np.unique(result.cloud.frame, return_index=True)
    since_s = dict(zip(frames.tolist(), 1e-9 * result.cloud.since_key_ns[rows], strict=True))
    far = {*result.far_frames} - {*result.T_key_lidar}
    return [
        {
            "frame": frame,
            "since_key_s": since_s.get(frame),
            "far": frame in far,
            "T_key_lidar": result.T_key_lidar.get(frame),
        }
        for frame in sorted({*since_s, *result.T_key_lidar})
    ]


def _view(view: CameraView) -> dict[str, Any]:
    camera = {f.name: getattr(view.camera, f.name) for f in fields(Camera)}
    return {**camera, "T_cam_key": view.T_cam_key, "late_s": view.late_s, "number": view.number}


def _movers(result: Result) -> list[dict[str, Any]]:
    """The objects with enough points, the largest first."""
    parts = [mover.cloud for instance, mover in result.movers.items() if instance >= 0]
    if not result.movers:
        cloud = result.cloud
        moving = cloud.select(cloud.moving & (cloud.instance >= 0))
        parts = [moving.select(moving.instance == i) for i in np.unique(moving.instance)]
    movers = [_mover(part) for part in parts if len(part) >= _LEAST_POINTS]
    return sorted(movers, key=lambda mover: -mover["num_points"])


def _mover(points: Cloud) -> dict[str, Any]:
    """One object. What one sweep sees of it is a part only, so its way is taken from how far its
    points were moved, not from their middle."""
    low, high = np.percentile(points.points, _SIZE_PERCENTILES, axis=0)
    centre_m, displacement_m = (low + high) / 2, points.points - points.rigid_points
    path = []
    for frame in np.unique(points.frame):
        own = points.frame == frame
        path.append(
            {
                "frame": frame,
                "since_key_s": points.since_key_ns[own][0] * 1e-9,
                "position_m": centre_m - np.median(displacement_m[own], axis=0),
            }
        )
    return {
        "instance": points.instance[0],
        "num_points": len(points),
        "centre_m": centre_m,
        "size_m": high - low,
        "velocity_m_s": np.median(points.velocity_m_s, axis=0),
        "path": path,
    }
