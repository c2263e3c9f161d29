# SPDX-License-Identifier: MIT
"""A short film of a finished run: registration alone turns into ours, then the sweeps of the window
come one by one. Small enough for a README.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from densify.config.errors import InputError, OutputError
from densify.geometry.types import Bool, Float
from densify.outputs.atomic import write_file
from densify.outputs.cloud_laz import StoredCloud, read_cloud

Picture = NDArray[np.uint8]

SUFFIXES = (".gif", ".mp4", ".webp")
_WIDTH_PX, _HEIGHT_PX = 640, 360
_FRAMES_PER_S = 10
_HOLD_S, _TURN_S, _SWEEP_S = 1.0, 1.6, 0.2
_EYE_M = (-21.0, 0.0, 13.5)
_TARGET_M = (9.0, 0.0, -0.5)
_FOCAL_PX = 0.62 * _WIDTH_PX
_POINT_M = 0.07
_LARGEST_POINT_PX = 4
_NEAR_M, _FAR_M = 1.0, 200.0
_SHADING, _MOST_SHADED = 1.6, 0.35
_BACKGROUND = 5, 7, 10
_GRAY = 60.0, 190.0
# Okabe and Ito's colours, which colour-blind people tell apart.
_OBJECTS = np.array(
    [
        *((230, 159, 0), (86, 180, 233), (0, 158, 115), (240, 228, 66)),
        *((0, 114, 178), (213, 94, 0), (204, 121, 167), (200, 200, 200)),
    ],
    np.uint8,
)
_WEBP_QUALITY = 60


class _View(NamedTuple):
    """Pixels of some points. depth_m: (H,W), infinite where there is none. rgb: (H,W,3)."""

    depth_m: Float
    rgb: Picture

    def over(self, other: _View) -> _View:
        """The view with another's points; the nearer ones are seen."""
        nearer = self.depth_m <= other.depth_m
        return _View(
            np.where(nearer, self.depth_m, other.depth_m),
            np.where(nearer[:, :, None], self.rgb, other.rgb),
        )


def check_film(out: Path, overwrite: bool = False) -> None:
    """Raise InputError for a kind of film that cannot be written here, and one that is there
    already unless it is to be overwritten."""
    if out.suffix not in SUFFIXES:
        raise InputError(f"--film {out}: expected a name that ends in {', '.join(SUFFIXES)}")
    if out.exists() and not overwrite:
        raise InputError(f"--film {out}: already there and kept; give --overwrite or another name")
    if out.suffix != ".mp4" and not hasattr(cv2, "imwriteanimation"):
        raise InputError(
            f"--film {out}: needs opencv-python-headless 4.11, got {cv2.__version__}; "
            f"pip install -U opencv-python-headless, or name it .mp4"
        )


def write_film(run: Path, out: Path, overwrite: bool = False) -> None:
    """Write the film of a key's folder as WebP (the smallest), GIF (256 colours) or MP4 (MPEG-4,
    which browsers do not play), by its name.

    Raises InputError as `check_film`, and if the run's cloud is missing, damaged or of an older
    version, OutputError if the film cannot be written.
    """
    check_film(out, overwrite)
    cloud = read_cloud(run / "cloud.laz")
    if cloud.displacement is None:
        raise InputError(f"{run}/cloud.laz: of an older version; densify the key again")
    pictures = list(_pictures(cloud))
    try:
        with tempfile.TemporaryDirectory() as place:
            aside = Path(place) / out.name
            (_write_video if out.suffix == ".mp4" else _write_animation)(aside, pictures)
            out.parent.mkdir(parents=True, exist_ok=True)
            write_file(out, aside.read_bytes())
    except (OSError, cv2.error) as error:
        raise OutputError(f"--film {out}: cannot be written: {error}") from error


def _pictures(cloud: StoredCloud) -> Iterator[tuple[Picture, float]]:
    """Pictures with how many seconds each is shown."""
    displacement = np.zeros((0, 3)) if cloud.displacement is None else cloud.displacement
    rgb, moving = _colours(cloud), cloud.moving
    standing = _seen(cloud.points[~moving], rgb[~moving])
    movers, back = cloud.points[moving], displacement[moving]
    num_turns = round(_TURN_S * _FRAMES_PER_S)
    for step in range(num_turns + 1):
        share = 0.5 - 0.5 * np.cos(np.pi * step / num_turns)  # 0 registration alone, 1 ours
        view = _seen(movers - (1 - share) * back, rgb[moving]).over(standing)
        ends = step in (0, num_turns)
        title = "registration alone" if share < 0.5 else "every sweep at the key's time"
        yield _drawn(view, title), _HOLD_S if ends else 1 / _FRAMES_PER_S
    so_far = _seen(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    window = ~cloud.far
    for number, frame in enumerate(np.unique(cloud.frame[window]).tolist(), 1):
        own = window & (cloud.frame == frame)
        so_far = _seen(cloud.points[own], rgb[own]).over(so_far)
        title = f"{number} sweep{'s' if number > 1 else ''}"
        yield _drawn(so_far, title), _SWEEP_S
    if cloud.far.any():
        title = "and what stands still along the road"
        yield _drawn(so_far.over(standing), title), 2 * _HOLD_S


def _colours(cloud: StoredCloud) -> Picture:
    """(M,3): the camera's, gray by reflectance where none saw the point, and a colour for each
    moving object."""
    dark, bright = _GRAY
    rgb = cloud.rgb.copy()
    unseen: Bool = ~rgb.any(axis=1)
    gray = dark + (bright - dark) * np.sqrt(np.clip(cloud.intensity[unseen], 0, 1))
    rgb[unseen] = gray.astype(np.uint8)[:, None]
    moving = cloud.moving
    rgb[moving] = _OBJECTS[cloud.instance[moving] % len(_OBJECTS)]
    return rgb


def _seen(points: Float, rgb: Picture) -> _View:
    """Points as squares of pixels, larger when near; the nearest is seen."""
    forward = np.subtract(_TARGET_M, _EYE_M)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    away = (points - np.array(_EYE_M)) @ np.stack([right, np.cross(forward, right), forward]).T
    z = away[:, 2]
    rows = np.flatnonzero((z > _NEAR_M) & (z < _FAR_M))
    rows = rows[np.argsort(-z[rows], kind="stable")]
    z = z[rows]
    u, v = (np.rint(_FOCAL_PX * away[rows, i] / z).astype(np.int64) for i in (0, 1))
    size_px = np.clip(np.rint(_FOCAL_PX * _POINT_M / z), 1, _LARGEST_POINT_PX)
    depth_m = np.full((_HEIGHT_PX, _WIDTH_PX), np.inf)
    picture = np.full((_HEIGHT_PX, _WIDTH_PX, 3), _BACKGROUND, np.uint8)
    for down in range(_LARGEST_POINT_PX):
        for along in range(_LARGEST_POINT_PX):
            x, y = u + _WIDTH_PX // 2 + along, v + _HEIGHT_PX // 2 + down
            drawn = (size_px > max(along, down)) & (x >= 0) & (x < _WIDTH_PX)
            drawn &= (y >= 0) & (y < _HEIGHT_PX)
            layer = np.full_like(depth_m, np.inf)
            layer[y[drawn], x[drawn]] = z[drawn]  # of several the last, which is the nearest
            colours = np.zeros_like(picture)
            colours[y[drawn], x[drawn]] = rgb[rows[drawn]]
            nearer = layer < depth_m
            depth_m[nearer], picture[nearer] = layer[nearer], colours[nearer]
    return _View(depth_m, picture)


def _drawn(view: _View, title: str) -> Picture:
    """BGR, darker where a pixel lies behind its neighbours (eye-dome lighting, Boucheny 2009)."""
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


def _write_animation(path: Path, pictures: Sequence[tuple[Picture, float]]) -> None:
    animation = cv2.Animation()
    animation.frames = [picture for picture, _ in pictures]
    animation.durations = [round(1000 * seconds) for _, seconds in pictures]
    animation.loop_count = 0
    options = [cv2.IMWRITE_WEBP_QUALITY, _WEBP_QUALITY] if path.suffix == ".webp" else []
    if not cv2.imwriteanimation(str(path), animation, options):
        raise OSError("opencv does not say why")


def _write_video(path: Path, pictures: Sequence[tuple[Picture, float]]) -> None:
    size_px = _WIDTH_PX, _HEIGHT_PX
    code = cv2.VideoWriter.fourcc(*"mp4v")
    video = cv2.VideoWriter(str(path), code, _FRAMES_PER_S, size_px)
    if not video.isOpened():
        raise OSError("this opencv has no encoder for it; name it .gif or .webp")
    for picture, seconds in pictures:
        for _ in range(round(seconds * _FRAMES_PER_S)):
            video.write(picture)
    video.release()
