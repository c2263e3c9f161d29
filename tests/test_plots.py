# SPDX-License-Identifier: MIT
"""Figures, curves of outliers over density, and the camera that comes first in all of them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.cli.runs import _front_first
from densify.geometry.types import CameraView
from densify.outputs import plots
from densify.outputs.plots import order_front_first
from densify.outputs.report_page import KeyFiles, key_page
from tests.exported import CAMERAS, camera_of, result_of, write_views


def test_the_figure_is_red_nearby_blue_far_away_and_gray_without_depth():
    depth_m = np.zeros((60, 600), np.float32)
    depth_m[:, :100], depth_m[:, 200:300], depth_m[30, 500] = 3.0, 80.0, 3.0
    figure = plots.draw_figure(
        np.full((60, 600, 3), 200, np.uint8), {"one": depth_m, "two": depth_m}
    )
    title, panel = figure[:36], figure[36:96].astype(int)
    assert figure.shape[1:] == (600, 3) and np.array_equal(figure[132:192], panel)
    assert (title == 255).all(axis=2).mean() > 0.9 and (title < 100).any()
    blue, _, red = panel[10, [50, 250]].T
    assert red[0] > 2 * blue[0] and blue[1] > red[1]
    gray = panel[10, 400]
    assert len({*gray}) == 1 and 0 < gray[0] < 200
    drawn = (panel != gray).any(axis=2)[:, 400:]
    assert drawn.sum() == 9 and drawn[29:32, 99:102].all()  # a measurement covers 3 x 3 pixels


def test_other_cameras_are_below_and_text_grows_with_the_width():
    images = {shape: np.full((*shape, 3), 200, np.uint8) for shape in ((60, 600), (90, 300))}
    front, side = images.values()
    depth_m = np.zeros((90, 300), np.float32)
    depth_m[40:50, 100:110] = 3.0
    alone = plots.draw_figure(front, {"front": np.zeros((60, 600), np.float32)})
    heights = []
    for num_others in (1, 2, 3):
        others = [("side", side, depth_m)] * num_others
        figure = plots.draw_figure(front, {"front": np.zeros((60, 600), np.float32)}, others)
        assert np.array_equal(figure[:96], alone[:96]) and figure.shape[1] == 600
        heights.append(len(figure) - len(alone))
        saturated = np.ptp(figure[96 : 96 + heights[-1]].astype(int), axis=2) > 100
        assert saturated[:, :300].any() and saturated[:, 300:].any() == (num_others > 1)
    assert heights == [36 + 180, 36 + 88, 2 * (36 + 88)]  # two beside each other, with a margin
    wide = plots.draw_figure(np.zeros((10, 2000, 3), np.uint8), {"a": np.zeros((10, 2000))})
    assert len(wide) == 2 * 36 + 10 + 2 * 60 and (wide[:72] == 0).any()


@pytest.mark.parametrize(
    ("num_compared", "expected"),
    [
        (200, ", 12.50 % outliers (truth)"),
        (199, ", outliers (truth): fewer than 200 pixels to judge"),
    ],
)
def test_a_share_of_few_pixels_is_no_figure(num_compared: int, expected: str) -> None:
    scores = {"num_pixels": 300, "num_compared": num_compared, "outliers": 0.125}
    result = result_of(cameras=("a",), depth={"a": {"measured": {"all": scores}}})
    assert plots._error(result, "a", "measured") == expected


# The camera that looks ahead

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


# Outliers over density


def curve_of(*pairs):
    """Measured pixels half as dense and with half the outliers."""
    return [
        {
            "min_confidence": 0.05 * i,
            "density_measured": d / 2,
            "outliers_measured": None if e is None else e / 2,
            "density_filled": d,
            "outliers_filled": e,
            "expected_filled": None if e is None else 2 * e,
        }
        for i, (d, e) in enumerate(pairs)
    ]


GOOD = curve_of((0.48, 0.004), (0.40, 0.001), (0.2, 0.0), (0.0, None))
POOR = curve_of((0.45, 0.17), (0.30, 0.12), (0.1, 0.1))


def test_every_camera_and_method_is_drawn_through_its_points() -> None:
    figure = plots.draw_curves({camera: {"icp": POOR, "flow": GOOD} for camera in "abc"})
    assert [axes.get_title() for axes in figure.axes] == [*"abc"]
    for axes in figure.axes:
        lines = {line.get_label(): line.get_xydata() for line in axes.lines}
        assert len(lines) == 5
        expected = lines["expected by confidence"]
        np.testing.assert_allclose(expected, [[48, 0.8], [40, 0.2], [20, 0.0]])
        np.testing.assert_allclose(
            lines["scene flow, filled: 48.0 % of pixels, 0.40 % outliers"],
            [[48, 0.4], [40, 0.1], [20, 0.0]],
        )
        measured = lines["rigid accumulation, measured: 22.5 % of pixels, 8.50 % outliers"]
        np.testing.assert_allclose(measured[0], [22.5, 8.5])
        low, high = axes.get_ylim()
        assert low == 0 and high > 17  # no outlier at all is on the axis too


def test_the_curves_of_a_result_are_of_all_cameras_and_methods(tmp_path) -> None:
    scores = {name: {"curve": GOOD} for name in CAMERAS}
    none, icp = result_of("none", held_out=None), result_of("icp", held_out=scores)
    flow = replace(result_of("flow", held_out=scores), baselines={"none": none, "icp": icp})
    plots.write_curve(flow, tmp_path)
    picture = (tmp_path / "curve.png").read_bytes()
    assert cv2.imread(str(tmp_path / "curve.png")).shape == (480, 1720, 3)
    plots.write_curve(flow, tmp_path)
    assert (tmp_path / "curve.png").read_bytes() == picture
    plots.write_curve(none, tmp_path / "nothing held out")
    assert not (tmp_path / "nothing held out").exists()


@pytest.mark.parametrize("ends", [(0.0, 0.0), (0.3, 0.3), (0.0, 0.97), (34.2, 59.9), (0.0, 126.0)])
def test_the_ticks_of_a_score_are_round_and_enclose_its_values(ends: tuple[float, float]):
    ticks = plots.Axis("score", *ends, {}, {}).ticks()
    assert ticks[0] <= ends[0] + 1e-6 and ticks[-1] >= ends[1] - 1e-6 and 2 <= len(ticks) <= 6
    assert np.allclose(np.diff(ticks), ticks[1] - ticks[0])
