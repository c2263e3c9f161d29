# SPDX-License-Identifier: MIT
"""A folder that nerfstudio opens (``ns-train depth-nerfacto --data DIR``, ``splatfacto``).

The world is the key frame. Poses are camera to world with OpenGL's axes: x right, y up, the camera
looks along -z. Depth is in millimetres, the unit that nerfstudio expects.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.geometry import poses
from densify.outputs.export.array_files import metres
from densify.outputs.export.cloud_files import save_ply
from densify.outputs.export.colmap import Picture, intrinsics, observed, write_pictures
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.map_outputs import map_path
from densify.outputs.plain import write_json

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_LENS, _FISHEYE_LENS = ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
_COLUMNS = ("x", "y", "z", "red", "green", "blue")


def write_nerfstudio(run: FinishedRun, folder: Path) -> None:
    """Write ``transforms.json``, ``images/``, ``depth/CAMERA.npy`` (measured, float32 millimetres,
    0 none) and ``cloud.ply``, the points that a camera observed.

    Raises InputError for maps of ranges, lenses other than OpenCV's with k1 k2 k3 p1 p2, and
    fisheyes together with others.
    """
    pictures = write_pictures(run, folder)
    models = {_model(picture) for picture in pictures}
    if len(models) > 1:
        raise InputError(
            "--to nerfstudio: it has one camera model for all images, and there are fisheyes and "
            "others; choose among them with --camera"
        )
    for picture in pictures:
        path = map_path(folder, "depth", picture.name, ".npy")
        np.save(path, metres(run.maps(picture.name)["depth"]) * np.float32(1000))
    columns = observed(run.cloud()).columns()
    save_ply(folder / "cloud.ply", {name: columns[name] for name in _COLUMNS})
    transforms = {
        "camera_model": models.pop(),
        "ply_file_path": "cloud.ply",
        "frames": [_frame(run, picture) for picture in pictures],
    }
    write_json(folder / "transforms.json", transforms)


def _model(picture: Picture) -> str:
    return "OPENCV_FISHEYE" if picture.view.camera.model == "fisheye" else "OPENCV"


def _frame(run: FinishedRun, picture: Picture) -> dict[str, Any]:
    camera, name = picture.view.camera, picture.name
    if run.measure(name) != "z":
        raise InputError(
            f"{name}: its depth is the range from the lens, and nerfstudio takes camera z; densify "
            f"it with --set project.depth=z, or leave it out by naming the others with --camera"
        )
    lens = intrinsics(camera)
    K = {"fl_x": lens.pop("fx"), "fl_y": lens.pop("fy"), "cx": lens.pop("cx"), "cy": lens.pop("cy")}
    known = _FISHEYE_LENS if camera.model == "fisheye" else _LENS
    if unknown := [n for n, value in lens.items() if value and n not in known]:
        raise InputError(
            f"{name}: nerfstudio has no lens with {', '.join(unknown)}; leave it out by naming the "
            f"others with --camera"
        )
    return {
        "file_path": f"images/{picture.file}",
        "depth_file_path": f"depth/{name}.npy",
        **K,
        "w": camera.width_px,
        "h": camera.height_px,
        **{n: lens.get(n, 0.0) for n in known},
        "transform_matrix": poses.inverse(picture.view.T_cam_key) @ _OPENGL,
    }
