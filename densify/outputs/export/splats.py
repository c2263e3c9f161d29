# SPDX-License-Identifier: MIT
"""What 3-D Gaussian splatting (Kerbl et al., SIGGRAPH 2023) starts from, with movers apart: the
standing world with its cameras, and each moving object in its own frame with its track.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from densify.geometry import poses
from densify.geometry.types import Float
from densify.outputs.atomic import write_file
from densify.outputs.export.colmap import packed_points, write_cameras
from densify.outputs.export.finished_run import FinishedRun
from densify.outputs.export.pictures import seen, write_pictures
from densify.outputs.export.ply import write_ply
from densify.outputs.plain import write_json
from densify.outputs.tracks import tracks_table


def write_export(run: FinishedRun, folder: Path) -> None:
    """``images/`` and ``sparse/0/`` with the cameras as `densify.outputs.export.colmap` and the
    standing world as points3D.bin and points3D.ply, what a camera saw of it;
    ``movers/0003.ply``: object 3, all its points, in its own frame; ``tracks.json``: as movers.json
    of the run, where each object is when. ``movers/others.ply``: what moves without a track, where
    it is at the key.

    Points have x y z, normals of 0 and a colour, as the method's own code reads them.
    """
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    write_cameras(sparse, write_pictures(run, folder / "images"))
    whole = run.cloud()
    standing = seen(whole.select(~whole.moving))
    write_file(sparse / "points3D.bin", packed_points(standing))
    _write_points(sparse / "points3D.ply", standing.points, standing.rgb)
    moving = [whole.select(whole.moving), *run.mover_clouds()]
    points, rgb, instance = (
        np.concatenate([getattr(cloud, name) for cloud in moving])
        for name in ("points", "rgb", "instance")
    )
    (folder / "movers").mkdir()
    known = np.zeros(len(points), bool)
    for track in run.tracks:
        own = instance == track.instance
        known |= own
        if own.any():
            T_object_key = poses.inverse(track.T_key_object[track.frames.index(run.key)])
            body = poses.transform(T_object_key, points[own])
            _write_points(folder / "movers" / f"{track.instance:04d}.ply", body, rgb[own])
    if not known.all():
        _write_points(folder / "movers" / "others.ply", points[~known], rgb[~known])
    write_json(folder / "tracks.json", tracks_table(run.key, run.tracks))


def _write_points(path: Path, points: Float, rgb: NDArray[np.uint8]) -> None:
    columns: dict[str, NDArray[Any]] = {
        axis: points[:, i].astype(np.float32) for i, axis in enumerate("xyz")
    }
    columns |= {name: np.zeros(len(points), np.float32) for name in ("nx", "ny", "nz")}
    write_ply(path, columns | {n: rgb[:, i] for i, n in enumerate(("red", "green", "blue"))})
