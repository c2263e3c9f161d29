# SPDX-License-Identifier: MIT
"""Pictures that say how much is wrong beside how dense: curve.png, and the titles of figure.png."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from densify.geometry.types import FullDepth, PriorFit
from densify.outputs import curve, figure
from densify.outputs.context import Context
from tests.test_output import H, W, result_of

SHARE = st.one_of(st.just(0.0), st.floats(2e-5, 1.0))


def points(*pairs):
    """Measured pixels half as dense and half as wrong."""
    return [
        {
            "min_confidence": 0.05 * i,
            "density_measured": None if d is None else d / 2,
            "outliers_measured": None if e is None else e / 2,
            "density_filled": d,
            "outliers_filled": e,
        }
        for i, (d, e) in enumerate(pairs)
    ]


GOOD = points((0.48, 0.004), (0.40, 0.001), (0.2, 0.0), (0.0, None))
POOR = points((0.45, 0.17), (0.30, 0.12), (0.1, 0.1))


@pytest.fixture
def written(monkeypatch):
    """Every text that is drawn."""
    texts = []
    put = cv2.putText

    def record(canvas, text, *rest):
        texts.append(text)
        return put(canvas, text, *rest)

    fake = SimpleNamespace(**{n: getattr(cv2, n) for n in dir(cv2) if not n.startswith("__")})
    fake.putText = record
    monkeypatch.setattr(curve, "cv2", fake)
    monkeypatch.setattr(figure, "cv2", fake)
    return texts


@given(st.lists(st.tuples(st.floats(0.0, 1.0), SHARE), min_size=1, max_size=20))
def test_axes_are_round_and_hold_every_point(pairs):
    axes = curve._Axes.over(points(*pairs))
    assert axes.step in (0.01, 0.02, 0.05, 0.1, 0.2)
    num = axes.most / axes.step
    assert abs(num - round(num)) < 1e-9 and 1 <= num <= 6.001
    assert axes.most >= max(d for d, _ in pairs) - 1e-9
    for end in (axes.low, axes.high):
        assert f"{end:.0e}"[0] in "125" and float(f"{end:.0e}") == pytest.approx(end)
    assert axes.high >= 10 * axes.low * (1 - 1e-9) and axes.high <= 1
    for d, e in pairs:
        assert curve._LEFT_PX <= axes.x(d) <= curve._WIDTH_PX - curve._RIGHT_PX + 1e-6
        if e > 0:
            lowest = curve._NONE_PX - curve._ZERO_PX
            assert curve._TOP_PX - 1e-6 <= axes.y(e) <= lowest + 1e-6


def test_no_error_is_off_the_logarithmic_axis():
    axes = curve._Axes.over(GOOD)
    assert axes.y(0.0) == curve._NONE_PX > axes.y(axes.low) + 20
    heights = [axes.y(e) for e in (axes.low, 1e-3, 4e-3, axes.high)]
    assert heights == sorted(heights, reverse=True)
    alone = curve.draw_curves({"left": {"flow": points((0.4, 0.0), (0.2, 0.0))}})
    stroke = (alone == curve._COLOURS[0]).all(axis=2)
    rows = np.flatnonzero(stroke[: curve._NONE_PX - 8, : int(axes.x(0.3))].any(axis=1))
    assert len(rows) == 0 or rows.max() > curve._NONE_PX - 60  # dots and names, no line


def test_every_camera_and_every_line_is_drawn(written):
    both = {"icp": POOR, "flow": GOOD}
    sizes = {}
    for num in (1, 2, 3):
        cameras = {f"camera_{i}": both for i in range(num)}
        picture = curve.draw_curves(cameras)
        sizes[num] = picture.shape[:2]
        assert picture.dtype == np.uint8
    h, w = curve._HEIGHT_PX, curve._WIDTH_PX
    assert sizes == {1: (h, w), 2: (h, 2 * w), 3: (2 * h, 2 * w)}
    for i in range(3):
        assert f"camera_{i}, key held out" in written
    names = ["icp, measured", "icp, filled", "flow, measured", "flow, filled"]
    assert [written.count(name) for name in names] == [6] * 4
    title = "flow: measured 24.0% of pixels, 0.20% wrong; filled 48.0% of pixels, 0.40% wrong"
    assert written.count(title) == 6
    assert {"0 %", "0.1 %", "1 %", "10 %"} <= set(written)
    assert {"0 %", "10 %", "20 %", "50 %"} <= set(written)


def test_a_line_goes_through_its_points():
    picture = curve.draw_curves({"left": {"icp": POOR, "flow": GOOD}})
    axes = curve._Axes.over([*POOR, *GOOD])
    for points_, colour in zip((POOR, GOOD), curve._COLOURS, strict=False):
        for p in points_:
            if p["outliers_filled"] is not None:
                x, y = axes.x(p["density_filled"]), axes.y(p["outliers_filled"])
                assert picture[round(y), round(x)].tolist() == list(colour)
    begin, end = ((axes.x(d), axes.y(e)) for d, e in ((0.48, 0.004), (0.40, 0.001)))
    x, y = (round((a + b) / 2) for a, b in zip(begin, end, strict=True))
    assert np.abs(picture[y, x].astype(int) - curve._COLOURS[1]).max() < 60


@example([[(0.125, 0.5)], [(0.125, 0.5), (0.171875, 0.125), (0.5, 0.5)]])  # no room off the lines
@given(
    st.lists(
        st.lists(st.tuples(st.floats(0.01, 0.6), st.floats(1e-4, 0.5)), min_size=1, max_size=5),
        min_size=1,
        max_size=3,
    )
)
def test_names_stay_apart_and_inside(curves):
    made = [points(*pairs) for pairs in curves]
    axes = curve._Axes.over([p for c in made for p in c])
    lines = [
        curve._Line(f"method{i}, filled", np.array([[axes.x(d), axes.y(e)] for d, e in pairs]),
                    (9, 9, 9), True)
        for i, pairs in enumerate(curves)
    ]  # fmt: skip
    boxes = []
    for line, (left, baseline) in zip(lines, curve._label_places(lines), strict=True):
        (width, height), _ = cv2.getTextSize(line.name, curve._FONT, curve._SIZE, 1)
        boxes.append((left, baseline - height, left + width, baseline))
        assert left > 0 and left + width < curve._WIDTH_PX
    for i, a in enumerate(boxes):
        for b in boxes[:i]:
            assert a[2] < b[0] or b[2] < a[0] or a[3] < b[1] or b[3] < a[1]


def held(pairs, wrong):
    return {"curve": points(*pairs), "measured": {"all": {"outliers": wrong}}}


def test_the_curves_of_a_result_are_of_all_cameras_and_methods(written, tmp_path):
    pairs = [(0.4, 0.01), (0.2, 0.002)]
    scores = {name: held(pairs, 0.01) for name in ("image_02", "image_03")}
    icp = result_of("icp", held_out=scores)
    none = result_of("none", held_out=None)
    flow = result_of("flow", held_out=scores)
    object.__setattr__(flow, "baselines", {"none": none, "icp": icp})
    curve.write_output(flow, Context({}, {}, "street"), tmp_path)
    assert cv2.imread(str(tmp_path / "curve.png")).shape[1] == 2 * curve._WIDTH_PX
    assert {"image_02, key held out", "image_03, key held out"} <= set(written)
    assert {"icp, filled", "flow, filled"} <= set(written) and "none, filled" not in written


def test_without_a_held_out_key_there_is_no_curve(tmp_path):
    curve.write_output(result_of("none", held_out=None), Context({}, {}, "street"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_titles_of_the_figure_say_error_beside_density(written, tmp_path):
    truth = {"image_02": {"measured": {"all": {"outliers": 0.0123}},
                          "full": {"all": {"outliers": 0.0345}}}}  # fmt: skip
    scores = {"image_02": held([], 0.0456)}
    known = result_of("flow", depth=truth, held_out=scores)
    fit = PriorFit("depth", 1.0, 0.0, 0.0, 0.0, True)
    ones = np.ones((H, W), np.float32)
    full = FullDepth(ones, ones / 20, ones > 0, fit, "prior.npy")
    object.__setattr__(known, "full", {"image_02": full})
    icp = result_of("icp", held_out=scores)
    none = result_of("none", held_out=None)
    results = {"none": none, "icp": icp, "flow": known}
    figure.write_figure(tmp_path / "figure.png", results, Context({}, {}, "street"))
    density = [f"{np.mean(r.depth['image_02'].depth_m > 0):.1%}" for r in results.values()]
    assert f"sparse: {density[0]} of pixels" in written
    assert f"icp: {density[1]} of pixels, 4.56% wrong (key held out)" in written
    assert f"flow: {density[2]} of pixels, 1.23% wrong (truth)" in written
    assert "flow and prior: 100.0% of pixels, 3.45% wrong (truth)" in written


def test_a_long_title_is_drawn_smaller_and_whole():
    text = "a method with a long name: 25.8% of pixels, 0.09% wrong (key held out), and more"
    bar = figure._title(text, 480)
    assert bar.shape[1] == 480 and not (bar[:, -8:] != 20).any() and (bar != 20).any()
