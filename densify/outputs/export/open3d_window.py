# SPDX-License-Identifier: MIT
"""Show finished runs in open3d's own viewer (https://www.open3d.org, extra ``open3d``)."""

from __future__ import annotations

from collections.abc import Sequence

from densify.config.errors import InputError
from densify.config.file_content import needed
from densify.outputs.export.finished_run import FinishedRun, colours, timelines


def show(runs: Sequence[FinishedRun]) -> None:
    """Show points and boxes, with a time line of several runs, until the window is closed."""
    o3d, shown = needed("open3d", "open3d", "Windows with the cloud"), []
    for at, line in enumerate(timelines(runs)):
        cloud, key = line.cloud, line.run.key
        for group, own in (("static", ~cloud.moving), ("moving", cloud.moving)):
            part = cloud.select(own)
            geometry = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(part.points))
            geometry.colors = o3d.utility.Vector3dVector(colours(part) / 255)
            geometry.transform(line.T_world_key)
            name = f"key {key}, {group}"
            shown.append({"name": name, "geometry": geometry, "group": group, "time": at})
        for track in line.run.tracks:
            T = line.T_world_key @ track.T_key_object[track.frames.index(key)]
            box = o3d.geometry.OrientedBoundingBox(T[:3, 3], T[:3, :3], track.size_m)
            name = f"key {key}, object {track.instance}"
            shown.append({"name": name, "geometry": box, "group": "objects", "time": at})
    try:
        o3d.visualization.draw(shown, title="densify", show_ui=True, show_skybox=False)
    except RuntimeError as error:
        raise InputError(
            f"open3d cannot open a window here ({error}): it needs a screen with its drivers; "
            f"densify report makes a page for any browser"
        ) from None
