# SPDX-License-Identifier: MIT
"""Write a video of finished runs: each camera's images above their filled depth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from densify.config.errors import OutputError
from densify.outputs.depth_png import Picture, metres
from densify.outputs.finished_run import FinishedRun
from densify.outputs.plots import coloured
from densify.readers.decoded_files import decode_image

_FRAMES_PER_S = 10.0
_BAR_PX = 6  # height of the bar that shows how far the video is
_MOST_WIDTH_PX = 1280


def write_mp4(runs: Sequence[FinishedRun], folder: Path) -> None:
    """Write ``video/CAMERA.mp4`` with a frame for each map, ascending in time."""
    shots = [(run, name) for run in runs for name in run.cameras]
    (folder / "video").mkdir()
    for camera in dict.fromkeys(name.partition("/")[0] for _, name in shots):
        path = folder / "video" / f"{camera}.mp4"
        of_camera = [(run, name) for run, name in shots if name.partition("/")[0] == camera]
        pictures = (_picture(run, name) for run, name in of_camera)
        first = next(pictures)
        size_px = first.shape[1], first.shape[0]
        code = cv2.VideoWriter.fourcc(*"mp4v")
        video = cv2.VideoWriter(str(path), code, _FRAMES_PER_S, size_px)
        if not video.isOpened():
            raise OutputError(f"{path}: this build of OpenCV writes no MPEG-4 video")
        for number, picture in enumerate([first, *pictures], start=1):
            frame = picture if picture.shape == first.shape else cv2.resize(picture, size_px)
            frame[-_BAR_PX:, : size_px[0] * number // len(of_camera)] = 255
            video.write(frame)
        video.release()


def _picture(run: FinishedRun, name: str) -> Picture:
    """Return an image above its filled depth, as (h,w,3) blue, green, red, and a black bar."""
    depth = coloured(metres(run.maps(name)["depth_filled"]))
    panels, jpeg = [depth], run.jpeg(name)
    if jpeg is not None:
        panels.insert(0, decode_image(jpeg, run.folder))
    picture = np.concatenate(panels)
    scale = min(1.0, _MOST_WIDTH_PX / picture.shape[1])
    # MPEG-4 needs even sizes.
    size_px = [2 * int(scale * length / 2) for length in picture.shape[1::-1]]
    shrunk = cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA)
    return cv2.copyMakeBorder(shrunk, 0, _BAR_PX, 0, 0, cv2.BORDER_CONSTANT).astype(np.uint8)
