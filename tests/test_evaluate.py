# SPDX-License-Identifier: MIT
"""Depth maps on disk against the truth on disk: which belong together, and what is printed."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.bench.depth import evaluate
from densify.outputs.depth_png import read_depth_png, write_depth_png
from densify.readers.depth_trees import DepthPair, pair_depth_files
from densify.scores.metrics import depth_errors
from tests.command import exit_code, refused
from tests.exported import refusal

DRIVE, OTHER_DRIVE = "2011_09_26_drive_0013_sync", "2011_09_28_drive_0002_sync"
LAYOUTS = {
    "tree": "{drive}/proj_depth/{product}/{camera}/{frame:010d}.png",
    "run": "{frame:06d}/{product}/{camera}.png",
    "run of a drive": "{drive}/{frame:06d}/{product}/{camera}.png",
    "plain": "{camera}/{frame:010d}.png",
    "selected": "{product}/{drive}_{product}_{frame:010d}_{camera}.png",
}


def path_of(root: Path, layout: str, frame: int, product: str = "", **changes: str) -> Path:
    product = product or ("depth" if "run" in layout else "groundtruth")
    names = {"drive": DRIVE, "camera": "image_02", "product": product, "frame": frame, **changes}
    return root / LAYOUTS[layout].format(**names)


def put(path: Path, *depths_m: float) -> Path:
    """A map of one row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth_png(path, np.array([depths_m or (10.0, 20.0)], np.float32))
    return path


def put_mask(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)
    return path


# Which belong together


@pytest.mark.parametrize("predicted_layout", LAYOUTS)
@pytest.mark.parametrize("truth_layout", ["tree", "selected"])
def test_layouts_pair_by_frame(tmp_path: Path, predicted_layout: str, truth_layout: str) -> None:
    maps = {f: put(path_of(tmp_path / "p", predicted_layout, f)) for f in (5, 120, 7)}
    true = {f: put(path_of(tmp_path / "t", truth_layout, f)) for f in (120, 5, 9)}
    pairs = pair_depth_files(tmp_path / "p", tmp_path / "t")
    assert pairs.pairs == (DepthPair(maps[5], true[5]), DepthPair(maps[120], true[120]))
    assert (pairs.without_truth, pairs.without_prediction) == ((maps[7],), (true[9],))
    assert pairs.without_mask == ()


def test_drive_and_camera_tell_files_apart_where_both_sides_say_them(tmp_path: Path) -> None:
    names = [(d, c) for d in (DRIVE, OTHER_DRIVE) for c in ("image_02", "image_03")]
    true, maps = (
        {(d, c): put(path_of(tmp_path / side, layout, 5, drive=d, camera=c)) for d, c in names}
        for side, layout in (("t", "tree"), ("p", "run of a drive"))
    )
    pairs = pair_depth_files(tmp_path / "p", tmp_path / "t").pairs
    assert {(p.predicted, p.truth) for p in pairs} == {(maps[k], true[k]) for k in names}
    # A run of one recording says no drive: two drives of truth are ambiguous, one is not.
    put(path_of(tmp_path / "run", "run", 5))
    with refusal("both frame 5 camera image_02", "one drive"):
        pair_depth_files(tmp_path / "run", tmp_path / "t")
    assert len(pair_depth_files(tmp_path / "run", tmp_path / "t" / DRIVE).pairs) == 1


def test_one_product_of_a_run_and_nothing_beside_it(tmp_path: Path) -> None:
    truth, out = put(tmp_path / "t" / "120.png"), tmp_path / "out"
    maps = {p: put(path_of(out, "run", 120, p)) for p in ("depth", "depth_filled", "confidence")}
    put(out / "000120" / "figure.png")
    put(out / ".000120.99.tmp" / "000121" / "depth" / "image_02.png")
    for filled, product in ((False, "depth"), (True, "depth_filled")):
        pairs = pair_depth_files(out, truth.parent, filled=filled)
        assert pairs.pairs == (DepthPair(maps[product], truth),) and not pairs.without_truth
    assert len(pair_depth_files(maps["depth_filled"].parent, truth.parent).pairs) == 1
    with refusal("--filled"):
        pair_depth_files(truth.parent, truth.parent, filled=True)
    (pair,) = pair_depth_files(out, out, filled=True).pairs
    assert pair == DepthPair(maps["depth_filled"], maps["depth"])


@pytest.mark.parametrize(
    ("filled", "product"), [(False, "groundtruth"), (True, "groundtruth_filled")]
)
def test_a_set_in_kittis_layout(tmp_path: Path, filled: bool, product: str) -> None:
    """As PREDICTED and as TRUTH, whatever its drives are called."""
    made, truth, drives = tmp_path / "set", tmp_path / "truth", ("street_seed-0", "scene-1", DRIVE)
    expected = set()
    for drive, frame in [(drive, frame) for drive in drives for frame in (5, 7)]:
        for kind in ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence"):
            put(path_of(made / "train", "tree", frame, kind, drive=drive))
        true = put(path_of(truth, "tree", frame, drive=drive))
        expected.add((path_of(made / "train", "tree", frame, product, drive=drive), true))
    put(path_of(truth, "tree", 5, drive="another"))
    pairs = pair_depth_files(made, truth, filled=filled)
    assert {(p.predicted, p.truth) for p in pairs.pairs} == expected
    assert pairs.without_truth == () and len(pairs.without_prediction) == 1
    itself = pair_depth_files(made, made, filled=filled).pairs
    assert len(itself) == 6 and all("/groundtruth/" in p.truth.as_posix() for p in itself)
    one = pair_depth_files(made / "train" / drives[1], truth).pairs
    assert {p.truth.parents[3].name for p in one} == {drives[1]}


def test_masks_pair_too_and_may_be_missing(tmp_path: Path) -> None:
    for frame in (5, 6):
        put(path_of(tmp_path / "out", "run", frame))
    true = [put(path_of(tmp_path / "t", "tree", frame)) for frame in (5, 6)]
    mask = put(tmp_path / "m" / "0000000005.png")
    pairs = pair_depth_files(tmp_path / "out", tmp_path / "t", tmp_path / "m")
    assert [pair.mask for pair in pairs.pairs] == [mask, None]
    assert pairs.without_mask == (true[1],)
    assert pair_depth_files(true[1], true[0], mask).pairs == (DepthPair(true[1], true[0], mask),)


def test_what_cannot_be_paired_is_refused(tmp_path: Path) -> None:
    truth, other = put(tmp_path / "t" / "5.png"), put(tmp_path / "p" / "6.png")
    (tmp_path / "empty").mkdir()
    for arguments, words in (
        ((other.parent, truth.parent), ("no pair of ", "6.png", "5.png")),
        ((other, truth.parent), ("no pair",)),
        ((tmp_path / "empty", truth), ("with PNG files",)),
        ((other.parent, tmp_path / "nowhere"), ("no such file",)),
        ((other.parent, truth.parent, truth), ("folder",)),
        ((other, truth, tmp_path), ("PNG file",)),
    ):
        with refusal(*words):
            pair_depth_files(*arguments)


# Scores


def test_scores_are_means_over_the_images(tmp_path: Path) -> None:
    put(tmp_path / "p" / "1.png", 10.0, 22.0, 0.0, 5.0)
    put(tmp_path / "t" / "1.png", 10.0, 20.0, 30.0, 0.0)
    put(tmp_path / "p" / "2.png", 14.0, 0.0)
    put(tmp_path / "t" / "2.png", 10.0, 0.0)
    put_mask(tmp_path / "m" / "1.png", np.array([[0, 1, 255, 1]], np.uint8))
    stereo = {"focal_px": 700.0, "baseline_m": 0.5}
    scores = evaluate(pair_depth_files(*(tmp_path / side for side in "ptm")), **stereo)
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    assert scores["num_images"] == 2
    assert scores["density"] == {"predicted": (0.75 + 0.5) / 2, "truth": (0.75 + 0.5) / 2}
    everything = scores["parts"]["all"]
    assert (everything["num_pixels"], everything["num_compared"]) == (4, 3)
    assert everything["mae_m"] == pytest.approx((1 + 4) / 2)
    assert everything["coverage"] == pytest.approx((2 / 3 + 1) / 2)
    # 35 -> 25 px is an outlier, 17.5 -> 15.9 is not
    assert everything["outliers"] == pytest.approx(0.5)
    for name, expected in {
        "moving": (1, 2, 2.0),
        "static": (1, 1, 0.0),
        "over 80 m": (0, 0, None),
    }.items():
        part = scores["parts"][name]
        assert (part["num_images"], part["num_pixels"], part["mae_m"]) == expected
    first, second = scores["images"]
    maps_m = (read_depth_png(tmp_path / side / "1.png") for side in "pt")
    assert asdict(depth_errors(*maps_m, **stereo)).items() <= first.items()
    assert first["mask"] is not None and second["mask"] is None
    assert scores["without_mask"] == [str(tmp_path / "t" / "2.png")]


@pytest.mark.parametrize("side", ["predicted", "truth"])
def test_maps_in_millimetres_are_named(side: str, tmp_path: Path) -> None:
    """As ScanNet, the RealSense and many networks store depth: 1000 x metres."""
    depth_m = np.linspace(3, 60, 200)
    noisy_m = depth_m * np.random.default_rng(0).normal(1, 0.03, 200)
    right, other = put(tmp_path / "right.png", *depth_m), tmp_path / "other.png"
    put(other, *(1000 / 256 * noisy_m))
    pair = (other, right) if side == "predicted" else (right, other)
    with refusal("other.png: ", " 1000 x metres ", " expected 256 x metres"):
        evaluate(pair_depth_files(*pair))
    put(other, *(3.4 * noisy_m))  # wrong, but of no known unit
    assert evaluate(pair_depth_files(*pair))["num_images"] == 1


def test_maps_of_another_size_are_refused(tmp_path: Path) -> None:
    a, b = put(tmp_path / "a.png", 1.0, 2.0), put(tmp_path / "b.png", 1.0, 2.0, 3.0)
    with refusal("a.png: got 2 x 1 px, expected 3 x 1, ", "b.png"):
        evaluate(pair_depth_files(a, b))
    mask = put_mask(tmp_path / "m.png", np.zeros((1, 3), np.uint8))
    with refusal("m.png: got 3 x 1 px, expected 2 x 1"):
        evaluate(pair_depth_files(a, a, mask))


def test_the_verb_prints_a_table_or_json(tmp_path: Path, capsys) -> None:
    for frame in range(9):
        put(path_of(tmp_path / "out", "run", frame), 10.5, 0.0, 60.0)
    for frame in (3, 20):
        put(path_of(tmp_path / "t", "tree", frame), 10.0, 20.0, 60.0)
    put_mask(tmp_path / "m" / "3.png", np.array([[1, 0, 0]], np.uint8))
    command = ["evaluate", tmp_path / "out", tmp_path / "t", "--mask", tmp_path / "m"]
    assert exit_code(*command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == (
        "1 image: predicted 66.67 % of the pixels, truth 100.00 %; outliers with fx 721.538 px, "
        "baseline 0.54 m"
    )
    assert lines[1].startswith("predicted without truth: 8: ") and "... and 3 more" in lines[1]
    lonely = path_of(tmp_path / "t", "tree", 20)
    assert lines[2] == f"truth without prediction: 1: {lonely}"
    titles, *rows = (re.split(r"\s{2,}", line.strip()) for line in lines[3:])
    table = {row[0]: dict(zip(titles, row[1:], strict=True)) for row in rows}
    assert (table["mae_m"]["all"], table["coverage"]["all"]) == ("0.25", "0.6667")
    assert (table["mae_m"]["moving"], table["imae_per_km"]["moving"]) == ("0.5", "4.762")
    assert (table["mae_m"]["20-30 m"], table["coverage"]["20-30 m"]) == ("-", "0")
    assert "over 80 m" not in titles
    assert exit_code(*command, "--json") == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert scores["schema_version"] == 1 and scores["parts"]["all"]["mae_m"] == 0.25
    (tmp_path / "broken.png").write_bytes(b"not a PNG")
    message = refused(capsys, 2, "evaluate", lonely, tmp_path / "broken.png")
    assert "broken.png: not a complete image" in message
