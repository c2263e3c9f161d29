# SPDX-License-Identifier: MIT
"""The output of what belongs to a key beside its maps: ``scene``, for pages, viewers and other
tools.

::

    scene/image/CAMERA.jpg             the image that the map shows
    scene/none/CAMERA.png, icp/…       measured depth of the simpler methods, as in ``depth``
    scene/truth/CAMERA.png             true depth where there is some, as in ``depth``
    scene/sweep/CAMERA.png             16 bit: of measured pixels 1 + place of the source sweep in
                                       ``sweeps`` of scene.json; 0 none
    scene/reason/CAMERA.png            8 bit `Reason` why a pixel's nearest point was
                                       left out (``output.rejected``)
    scene/scene.json                   key, and
      sweeps    of the window and beyond it: frame, since_key_s, far, and of the window's
                T_key_lidar (4,4)
      views     map -> the camera (width_px, height_px, K, model, distortion, ...), T_cam_key (4,4)
                when it shows the scene, late_s after the key, number of its image
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry.types import Camera, CameraView, Result
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.outputs.depth_png import write_depth_png
from densify.outputs.plain import write_json
from densify.outputs.png import encode_jpeg, encode_png

SCHEMA_VERSION = 1


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
