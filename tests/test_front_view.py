# SPDX-License-Identifier: MIT
"""Pictures and pages of a run with several cameras begin with the camera that looks ahead."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from densify.cli.runs import _front_first
from densify.geometry.types import CameraView
from densify.outputs.plots import order_front_first
from densify.outputs.report_page import KeyFiles, key_page
from tests.exported import camera_of, write_views

NAMES = ["back", "left", "straight"]
AXES = {"back": [-1, 0, 0], "left": [0, 1, 0], "straight": [1, 0, 0]}  # in the key frame
VIEWS = {}
for _name, _axis in AXES.items():
    _T_cam_key = np.eye(4)
    _T_cam_key[:3, :3] = [np.cross(_axis, [0, 0, 1]), [0, 0, -1], _axis]
    VIEWS[_name] = CameraView(camera_of(_name, "plain"), _T_cam_key, 0.0, None)


def travel(x_m: float, y_m: float) -> dict[int, np.ndarray]:
    poses = {frame: np.eye(4) for frame in (119, 120, 121)}
    poses[119][:2, 3], poses[121][:2, 3] = (-x_m / 2, -y_m / 2), (x_m / 2, y_m / 2)
    return poses


@pytest.mark.parametrize(
    ("names", "poses", "expected"),
    [
        (NAMES, travel(5, 0.5), ["straight", "back", "left"]),
        (NAMES, travel(0.3, 5), ["left", "back", "straight"]),  # y forward
        (["image_02", "image_03"], travel(0.1, 0.2), ["image_02", "image_03"]),  # at rest
        (["left", "other"], travel(-5, 0), ["left", "other"]),
        ([], {}, []),
        (["BACK", "FRONT_LEFT", "FRONT"], {}, ["FRONT", "BACK", "FRONT_LEFT"]),
        (["rear_left", "front_left"], {}, ["front_left", "rear_left"]),
    ],
)
def test_travel_decides_or_at_rest_the_name(names, poses, expected) -> None:
    assert order_front_first(names, VIEWS, poses) == expected


def test_the_page_and_the_screen_begin_with_it(tmp_path: Path) -> None:
    lenses = dict.fromkeys(NAMES, "plain")
    run, result = write_views(tmp_path, lenses, views=VIEWS, T_key_lidar=travel(5, 0))
    page = key_page(KeyFiles.of_run(run), "").decode()
    assert re.search(r'"cameras":\s*{\s*"straight":', page)
    paths = [run / "depth_filled" / f"{name}.png" for name in NAMES]
    assert _front_first(paths, result)[0] == paths[2]
