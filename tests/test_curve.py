# SPDX-License-Identifier: MIT
"""Plots: outliers over density, losses of a training, flow from above."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from densify.outputs import plots
from tests.exported import CAMERAS, result_of


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
