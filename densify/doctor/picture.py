# SPDX-License-Identifier: MIT
"""Three overlays in one picture: neighbouring sweeps from above, depth over the image, depth edges
over image edges."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError
from densify.doctor.cameras import image_pairs
from densify.doctor.sample import Sample, Spot
from densify.geometry import poses
from densify.geometry.cameras import image_points
from densify.geometry.types import Camera, Float

Picture = NDArray[np.uint8]
_SIZE_PX, _REACH_M = 700, 35.0
_WIDTH_PX = 1000
_FIRST, _SECOND = (90, 190, 255), (255, 150, 60)  # RGB, told apart by the colour-blind too
_NEAR_M, _FAR_M = 3.0, 60.0
_LEAST_HEIGHT_M = 0.4
_INK = (235, 235, 235)


def draw(sample: Sample) -> Picture:
    """(H,W,3) RGB. Of the fastest spot, where mistakes show most; black where there is nothing."""
    panels = [_from_above(sample.fastest)]
    for camera in sample.sequence.cameras.values():
        pairs, _ = image_pairs(sample, camera)
        if not pairs:
            continue
        pair = pairs[len(pairs) // 2]
        try:
            image = sample.sequence.image(camera.name, pair.number)
        except InputError:
            continue
        cam = poses.transform(camera.T_cam_lidar, pair.seen_at(0.0))
        uv, seen = image_points(camera, cam)
        depth = _dots(image, uv[seen], _colours(cam[seen, 2]), camera)
        edges = np.repeat((60 * pair.strength).clip(0, 255).astype(np.uint8)[:, :, None], 3, axis=2)
        on_edge = seen & pair.edge
        orange = np.tile(np.array(_SECOND, np.uint8), (int(on_edge.sum()), 1))
        edged = _dots(edges, uv[on_edge], orange, camera)
        panels.append(_titled(depth, f"{camera.name} {pair.number}: depth over the image"))
        panels.append(_titled(edged, f"{camera.name}: depth edges (orange) over image edges"))
        break
    width = max(panel.shape[1] for panel in panels)
    padded = [
        cv2.copyMakeBorder(p, 0, 6, 0, width - p.shape[1], cv2.BORDER_CONSTANT) for p in panels
    ]
    return np.concatenate(padded).astype(np.uint8)


def _from_above(spot: Spot | None) -> Picture:
    picture = np.zeros((_SIZE_PX, _WIDTH_PX, 3), np.uint8)
    if spot is not None:
        row = spot.middle
        here, there = spot.stretch.sweeps[row], spot.stretch.sweeps[max(row - 1, 0)]
        T_here_there = poses.inverse(here.T_world_lidar) @ there.T_world_lidar
        for points, colour in (
            (poses.transform(T_here_there, there.sweep.points), _FIRST),
            (here.sweep.points, _SECOND),
        ):
            _draw_points(picture, points, colour)
    speed = "not registered" if spot is None else f"{spot.speed_m_s:.1f} m/s"
    title = f"two neighbouring sweeps from above ({speed}): blue the earlier, orange the later"
    return _titled(picture, title)


def _draw_points(picture: Picture, points: Float, colour: tuple[int, int, int]) -> None:
    height_m = points[:, 2] - np.percentile(points[:, 2], 5)
    points = points[height_m > _LEAST_HEIGHT_M]
    scale = _SIZE_PX / (2 * _REACH_M)
    column = np.rint(_WIDTH_PX / 2 + scale * points[:, 0]).astype(int)
    line = np.rint(_SIZE_PX / 2 - scale * points[:, 1]).astype(int)
    inside = (column >= 0) & (column < _WIDTH_PX) & (line >= 0) & (line < _SIZE_PX)
    picture[line[inside], column[inside]] = np.maximum(
        picture[line[inside], column[inside]], np.array(colour, np.uint8)
    )


def _colours(depth_m: Float) -> Picture:
    """(N,) -> (N,3): near red, far blue."""
    share = np.log(depth_m.clip(_NEAR_M, _FAR_M) / _NEAR_M) / np.log(_FAR_M / _NEAR_M)
    level = (20 + 218 * (1 - share)).astype(np.uint8)
    bgr = cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)[:, 0]
    return np.ascontiguousarray(bgr[:, ::-1])


def _dots(image: Picture, uv: Float, colours: Picture, camera: Camera) -> Picture:
    picture = (0.5 * image).astype(np.uint8)
    radius = max(1, round(camera.focal_px / 900))
    for (u, v), colour in zip(np.rint(uv).astype(int), colours.tolist(), strict=True):
        cv2.circle(picture, (int(u), int(v)), radius, colour, -1)
    scale = _WIDTH_PX / picture.shape[1]
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _titled(picture: Picture, text: str) -> Picture:
    bar = np.zeros((26, picture.shape[1], 3), np.uint8)
    cv2.putText(bar, text, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return np.concatenate([bar, picture]).astype(np.uint8)
