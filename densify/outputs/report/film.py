# SPDX-License-Identifier: MIT
"""A short film of a finished run: registration alone turns into the result, then the sweeps of the
window appear one by one."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from densify.config.errors import InputError, OutputError
from densify.geometry.types import Float
from densify.outputs.atomic import file_aside
from densify.outputs.cloud_laz import StoredCloud, read_cloud
from densify.outputs.png import Picture

SUFFIXES = (".gif", ".webp")
_WIDTH_PX, _HEIGHT_PX = 640, 360
_HOLD_S, _TURN_S, _SWEEP_S, _STEP_S = 1.0, 1.6, 0.2, 0.1
_EYE_M, _TARGET_M = np.array([-21.0, 0.0, 13.5]), np.array([9.0, 0.0, -0.5])
_FOCAL_PX = 0.62 * _WIDTH_PX
_POINT_M = 0.07
_LARGEST_POINT_PX = 4
_NEAR_M, _FAR_M = 1.0, 200.0
_SHADING, _MOST_SHADED = 1.6, 0.35
_BACKGROUND = 5, 7, 10
_GRAY = 60.0, 190.0
_OBJECTS = np.array(  # Okabe and Ito's colours, which colour-blind people can distinguish
    [[230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66], [213, 94, 0], [204, 121, 167]],
    np.uint8,
)
_WEBP_QUALITY = 60


class _View(NamedTuple):
    """Rendered points. depth_m: (H,W), infinite without a point. rgb: (H,W,3)."""

    depth_m: Float
    rgb: Picture

    def over(self, other: _View) -> _View:
        """Return both views together; the nearer points are visible."""
        nearer = self.depth_m <= other.depth_m
        rgb = np.where(nearer[:, :, None], self.rgb, other.rgb)
        return _View(np.where(nearer, self.depth_m, other.depth_m), rgb)


def check_film(out: Path, overwrite: bool = False) -> None:
    """Raise InputError for a name that is no kind of film, and for a film that is there already
    unless it is to be overwritten."""
    if out.suffix not in SUFFIXES:
        raise InputError(f"--film {out}: expected a name that ends in {' or '.join(SUFFIXES)}")
    if out.exists() and not overwrite:
        raise InputError(f"--film {out}: already there and kept; give --overwrite or another name")


def write_film(run: Path, out: Path, overwrite: bool = False) -> None:
    """Write the film of a key's folder, by its name as WebP, which is smaller, or GIF.

    Raises InputError as `check_film`, and if the run's cloud is missing or damaged, OutputError if
    the film cannot be written.
    """
    check_film(out, overwrite)
    pictures = list(_pictures(read_cloud(run / "cloud.laz")))
    animation = cv2.Animation()
    animation.frames = [picture for picture, _ in pictures]
    animation.durations = [round(1000 * seconds) for _, seconds in pictures]
    animation.loop_count = 0
    options = [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY] if out.suffix == ".webp" else []
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with file_aside(out) as aside:
            if not cv2.imwriteanimation(str(aside), animation, options):
                raise OSError("opencv does not say why")
    except (OSError, cv2.error) as error:
        raise OutputError(f"--film {out}: cannot be written: {error}") from error


def _pictures(cloud: StoredCloud) -> Iterator[tuple[Picture, float]]:
    """Yield pictures, and how many seconds each is shown."""
    rgb, moving, window = _colours(cloud), cloud.moving, ~cloud.far
    static = _render(cloud.points[~moving], rgb[~moving])
    num_steps = round(_TURN_S / _STEP_S)
    for step in range(num_steps + 1):
        share = 0.5 - 0.5 * np.cos(np.pi * step / num_steps)  # 0 registration alone, 1 result
        points = cloud.points[moving] - (1 - share) * cloud.displacement[moving]
        title = "registration alone" if share < 0.5 else "every sweep at the key's time"
        view = _render(points, rgb[moving]).over(static)
        yield _finish(view, title), _HOLD_S if step in (0, num_steps) else _STEP_S
    so_far = _render(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    for number, frame in enumerate(np.unique(cloud.frame[window]).tolist(), 1):
        own = window & (cloud.frame == frame)
        so_far = _render(cloud.points[own], rgb[own]).over(so_far)
        yield _finish(so_far, f"{number} sweep{'s' if number > 1 else ''}"), _SWEEP_S
    if cloud.far.any():
        view = so_far.over(static)
        yield _finish(view, "and the static points along the road"), 2 * _HOLD_S


def _colours(cloud: StoredCloud) -> Picture:
    """Return (N,3): the camera's colour, gray by reflectance where no camera observed the point,
    and one colour for each moving object."""
    dark, bright = _GRAY
    gray = dark + (bright - dark) * np.sqrt(np.clip(cloud.intensity, 0, 1))
    observed = cloud.rgb.any(axis=1, keepdims=True)
    rgb = np.where(observed, cloud.rgb, gray[:, None]).astype(np.uint8)
    rgb[cloud.moving] = _OBJECTS[cloud.instance[cloud.moving] % len(_OBJECTS)]
    return rgb


def _render(points: Float, rgb: Picture) -> _View:
    """Draw points as squares, larger when near. The nearest point is visible."""
    forward = (_TARGET_M - _EYE_M) / np.linalg.norm(_TARGET_M - _EYE_M)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    in_view = (points - _EYE_M) @ np.stack([right, np.cross(forward, right), forward]).T
    rows = np.flatnonzero((in_view[:, 2] > _NEAR_M) & (in_view[:, 2] < _FAR_M))
    rows = rows[np.argsort(-in_view[rows, 2], kind="stable")]
    z = in_view[rows, 2]
    u, v = (np.rint(_FOCAL_PX * in_view[rows, i] / z).astype(np.int64) for i in (0, 1))
    size_px = np.clip(np.rint(_FOCAL_PX * _POINT_M / z), 1, _LARGEST_POINT_PX)
    nearest = _View(
        np.full((_HEIGHT_PX, _WIDTH_PX), np.inf),
        np.full((_HEIGHT_PX, _WIDTH_PX, 3), _BACKGROUND, np.uint8),
    )
    for down, along in np.ndindex(_LARGEST_POINT_PX, _LARGEST_POINT_PX):
        x, y = u + _WIDTH_PX // 2 + along, v + _HEIGHT_PX // 2 + down
        drawn = (size_px > max(along, down)) & (x >= 0) & (x < _WIDTH_PX)
        drawn &= (y >= 0) & (y < _HEIGHT_PX)
        layer = _View(np.full_like(nearest.depth_m, np.inf), np.zeros_like(nearest.rgb))
        layer.depth_m[y[drawn], x[drawn]] = z[drawn]  # of several the last, which is the nearest
        layer.rgb[y[drawn], x[drawn]] = rgb[rows[drawn]]
        nearest = nearest.over(layer)
    return nearest


def _finish(view: _View, title: str) -> Picture:
    """Return BGR with a title, darker where a pixel lies behind its neighbours (eye-dome lighting,
    Boucheny 2009)."""
    log_depth = np.log2(np.minimum(view.depth_m, 1e6))
    around = np.pad(log_depth, 1, mode="edge")
    behind = np.zeros_like(log_depth)
    for other in (around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]):
        behind += np.clip(log_depth - other, 0, _MOST_SHADED)
    behind[np.isinf(view.depth_m)] = 0
    shaded = view.rgb * np.exp(-_SHADING * behind)[:, :, None]
    picture: Picture = np.ascontiguousarray(np.rint(shaded).astype(np.uint8)[:, :, ::-1])
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.65
    width_px = cv2.getTextSize(title, font, size, 1)[0][0]
    picture[8:38, 8 : 20 + width_px] //= 4
    cv2.putText(picture, title, (14, 29), font, size, (255, 255, 255), 1, cv2.LINE_AA)
    return picture
