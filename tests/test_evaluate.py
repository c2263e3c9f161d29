# SPDX-License-Identifier: MIT
"""Depth maps on disk against the truth on disk: which belong together, and what the verb says."""

from __future__ import annotations

import json
import re
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np
import pytest

from densify.bench.evaluation import evaluate
from densify.cli import main
from densify.config.errors import InputError
from densify.outputs.depth_png import read_depth_png, write_depth_png
from densify.readers.depth_trees import DepthPair, pair_depth_files
from densify.scores.depth_metrics import depth_errors

DRIVE, OTHER_DRIVE = "2011_09_26_drive_0013_sync", "2011_09_28_drive_0002_sync"


def put(path: Path, *depths_m: float) -> Path:
    """A map of one row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_depth_png(path, np.array([depths_m or (10.0, 20.0)], np.float32))
    return path


def put_mask(path: Path, values: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)
    return path


def official(root: Path, frame: int, drive: str = DRIVE, camera: str = "image_02") -> Path:
    return root / drive / "proj_depth" / "groundtruth" / camera / f"{frame:010d}.png"


def own(out: Path, frame: int, product: str = "depth", camera: str = "image_02") -> Path:
    return out / f"{frame:06d}" / product / f"{camera}.png"


def selected(root: Path, frame: int, product: str, drive: str = DRIVE) -> Path:
    return root / product / f"{drive}_{product}_{frame:010d}_image_02.png"


def refusal(*arguments: object, **options: bool) -> str:
    with pytest.raises(InputError) as caught:
        pair_depth_files(*arguments, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    return str(caught.value)


# --- which belong together ------------------------------------------------------------------------


def test_two_files_are_a_pair_whatever_their_names(tmp_path: Path) -> None:
    a, b, mask = put(tmp_path / "a.png"), put(official(tmp_path, 5)), put(tmp_path / "m.png")
    assert pair_depth_files(a, b).pairs == (DepthPair(a, b),)
    assert pair_depth_files(a, b, mask).pairs == (DepthPair(a, b, mask),)


@pytest.mark.parametrize("predicted_layout", ["official", "own", "plain", "selected", "drive/own"])
@pytest.mark.parametrize("truth_layout", ["official", "selected"])
def test_layouts_pair_by_frame(tmp_path: Path, predicted_layout: str, truth_layout: str) -> None:
    def path(side: str, layout: str, frame: int) -> Path:
        root = tmp_path / side
        return {
            "official": official(root, frame),
            "own": own(root, frame),
            "drive/own": own(root / DRIVE, frame),
            "plain": root / "image_02" / f"{frame:010d}.png",
            "selected": selected(root, frame, "groundtruth_depth"),
        }[layout]

    found = {f: put(path("predicted", predicted_layout, f)) for f in (5, 120, 7)}
    true = {f: put(path("truth", truth_layout, f)) for f in (120, 5, 9)}
    pairs = pair_depth_files(tmp_path / "predicted", tmp_path / "truth")
    assert pairs.pairs == (DepthPair(found[5], true[5]), DepthPair(found[120], true[120]))
    assert (pairs.without_truth, pairs.without_prediction) == ((found[7],), (true[9],))
    assert pairs.without_mask == ()


def test_drive_and_camera_tell_files_apart_where_both_sides_say_them(tmp_path: Path) -> None:
    places = [(d, c) for d in (DRIVE, OTHER_DRIVE) for c in ("image_02", "image_03")]
    true = {place: put(official(tmp_path / "t", 5, *place)) for place in places}
    found = {(d, c): put(own(tmp_path / "p" / d, 5, camera=c)) for d, c in places}
    pairs = pair_depth_files(tmp_path / "p", tmp_path / "t").pairs
    assert {(p.predicted, p.truth) for p in pairs} == {(found[k], true[k]) for k in places}
    # A run of one recording says no drive: two drives of truth are ambiguous, one is not.
    put(own(tmp_path / "run", 5))
    line = refusal(tmp_path / "run", tmp_path / "t")
    assert "both frame 5 camera image_02" in line and "one drive" in line
    assert len(pair_depth_files(tmp_path / "run", tmp_path / "t" / DRIVE).pairs) == 1


def test_of_our_output_one_product_and_nothing_beside_it(tmp_path: Path) -> None:
    truth = put(tmp_path / "t" / "120.png")
    for product in ("depth", "depth_filled", "confidence"):
        put(own(tmp_path / "out", 120, product))
    put(tmp_path / "out" / "000120" / "figure.png")
    put(tmp_path / "out" / ".000120.99.tmp" / "000121" / "depth" / "image_02.png")
    for filled, product in ((False, "depth"), (True, "depth_filled")):
        pairs = pair_depth_files(tmp_path / "out", truth.parent, filled=filled)
        assert pairs.pairs == (DepthPair(own(tmp_path / "out", 120, product), truth),)
        assert pairs.without_truth == ()
    only_filled = own(tmp_path / "out", 120, "depth_filled").parent
    assert len(pair_depth_files(only_filled, truth.parent).pairs) == 1
    assert "--filled" in refusal(truth.parent, truth.parent, filled=True)
    both = pair_depth_files(tmp_path / "out", tmp_path / "out", filled=True).pairs
    filled_map, depth = (own(tmp_path / "out", 120, p) for p in ("depth_filled", "depth"))
    assert both == (DepthPair(filled_map, depth),)


def tree(root: Path, drive: str, product: str, frame: int, camera: str = "front") -> Path:
    return root / drive / "proj_depth" / product / camera / f"{frame:010d}.png"


TREE = ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")
NAMES = ("street-street_seed-0", "scene-0061", DRIVE)


@pytest.mark.parametrize(("filled", "product"), [(False, "groundtruth"), (True, TREE[2])])
def test_a_set_in_kittis_layout(tmp_path: Path, filled: bool, product: str) -> None:
    """As PREDICTED and as TRUTH, whatever its drives are called."""
    made, truth = tmp_path / "set", tmp_path / "truth"
    for drive in NAMES:
        for frame in (5, 7):
            for kind in TREE:
                put(tree(made / "train", drive, kind, frame))
            put(tree(truth, drive, "groundtruth", frame))
    put(tree(truth, "another", "groundtruth", 5))
    pairs = pair_depth_files(made, truth, filled=filled)
    assert {(p.predicted, p.truth) for p in pairs.pairs} == {
        (tree(made / "train", drive, product, f), tree(truth, drive, "groundtruth", f))
        for drive in NAMES
        for f in (5, 7)
    }
    assert pairs.without_truth == () and len(pairs.without_prediction) == 1
    both = pair_depth_files(made, made, filled=filled).pairs
    assert len(both) == 6 and all("/groundtruth/" in p.truth.as_posix() for p in both)
    one = pair_depth_files(made / "train" / NAMES[1], truth).pairs
    assert {p.truth.parents[3].name for p in one} == {NAMES[1]}


def test_masks_pair_too_and_may_be_missing(tmp_path: Path) -> None:
    for frame in (5, 6):
        put(own(tmp_path / "out", frame))
    true = [put(official(tmp_path / "t", frame)) for frame in (5, 6)]
    mask = put(tmp_path / "m" / "0000000005.png")
    pairs = pair_depth_files(tmp_path / "out", tmp_path / "t", tmp_path / "m")
    assert [pair.mask for pair in pairs.pairs] == [mask, None]
    assert pairs.without_mask == (true[1],)
    assert "folder" in refusal(tmp_path / "out", tmp_path / "t", mask)
    assert "PNG file" in refusal(true[0], true[1], tmp_path / "m")


def test_what_cannot_be_paired_is_refused(tmp_path: Path) -> None:
    truth, other = put(tmp_path / "t" / "5.png"), put(tmp_path / "p" / "6.png")
    (tmp_path / "empty").mkdir()
    line = refusal(other.parent, truth.parent)
    assert line.startswith("no pair of ") and "6.png" in line and "5.png" in line
    assert "with PNG files" in refusal(tmp_path / "empty", truth)
    assert "no such file" in refusal(other.parent, tmp_path / "nowhere")
    assert refusal(other, truth.parent).startswith("no pair")


# --- scores ---------------------------------------------------------------------------------------


def test_scores_are_means_over_the_images(tmp_path: Path) -> None:
    put(tmp_path / "p" / "1.png", 10.0, 22.0, 0.0, 5.0)
    put(tmp_path / "t" / "1.png", 10.0, 20.0, 30.0, 0.0)
    put(tmp_path / "p" / "2.png", 14.0, 0.0)
    put(tmp_path / "t" / "2.png", 10.0, 0.0)
    put_mask(tmp_path / "m" / "1.png", np.array([[0, 1, 255, 1]], np.uint8))
    places = (tmp_path / side for side in "ptm")
    scores = evaluate(pair_depth_files(*places), focal_px=700.0, baseline_m=0.5)
    assert json.loads(json.dumps(scores, allow_nan=False)) == scores
    assert scores["num_images"] == 2
    assert scores["density"] == {"predicted": (0.75 + 0.5) / 2, "truth": (0.75 + 0.5) / 2}
    everything = scores["parts"]["all"]
    assert (everything["num_pixels"], everything["num_compared"]) == (4, 3)
    assert everything["mae_m"] == pytest.approx((1 + 4) / 2)
    assert everything["coverage"] == pytest.approx((2 / 3 + 1) / 2)
    # 35 -> 25 px is wrong, 17.5 -> 15.9 is not
    assert everything["outliers"] == pytest.approx(0.5)
    moving, static = scores["parts"]["moving"], scores["parts"]["static"]
    assert (moving["num_images"], moving["num_pixels"], moving["mae_m"]) == (1, 2, 2.0)
    assert (static["num_images"], static["num_pixels"], static["mae_m"]) == (1, 1, 0.0)
    assert scores["parts"]["over 80 m"]["num_images"] == 0
    assert scores["parts"]["over 80 m"]["mae_m"] is None
    first = scores["images"][0]
    errors = depth_errors(
        read_depth_png(tmp_path / "p" / "1.png"),
        read_depth_png(tmp_path / "t" / "1.png"),
        focal_px=700.0,
        baseline_m=0.5,
    )
    assert {name: first[name] for name in asdict(errors)} == asdict(errors)
    assert first["mask"] is not None and scores["images"][1]["mask"] is None
    assert scores["without_mask"] == [str(tmp_path / "t" / "2.png")]


@pytest.mark.parametrize("side", ["predicted", "truth"])
def test_maps_in_millimetres_are_named(side: str, tmp_path: Path) -> None:
    """As ScanNet, the RealSense and many networks store depth: 1000 x metres."""
    depth_m = np.linspace(3, 60, 200)
    noisy_m = depth_m * np.random.default_rng(0).normal(1, 0.03, 200)
    right, other = put(tmp_path / "right.png", *depth_m), tmp_path / "other.png"
    put(other, *(1000 / 256 * noisy_m))
    pair = (other, right) if side == "predicted" else (right, other)
    with pytest.raises(InputError, match=r"other\.png: .* 1000 x metres .* expected 256 x metres"):
        evaluate(pair_depth_files(*pair))
    put(other, *(3.4 * noisy_m))  # wrong, but of no known unit
    assert evaluate(pair_depth_files(*pair))["num_images"] == 1


def test_maps_of_another_size_are_refused(tmp_path: Path) -> None:
    a, b = put(tmp_path / "a.png", 1.0, 2.0), put(tmp_path / "b.png", 1.0, 2.0, 3.0)
    with pytest.raises(InputError, match=r"a\.png: got 2 x 1 px, expected 3 x 1, .*b\.png"):
        evaluate(pair_depth_files(a, b))
    mask = put_mask(tmp_path / "m.png", np.zeros((1, 3), np.uint8))
    with pytest.raises(InputError, match=r"m\.png: got 3 x 1 px, expected 2 x 1"):
        evaluate(pair_depth_files(a, a, mask))


# --- the verb -------------------------------------------------------------------------------------


def test_the_verb_prints_a_table_or_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for frame in range(9):
        put(own(tmp_path / "out", frame), 10.5, 0.0, 60.0)
    for frame in (3, 20):
        put(official(tmp_path / "t", frame), 10.0, 20.0, 60.0)
    mask = put_mask(tmp_path / "m" / "3.png", np.array([[1, 0, 0]], np.uint8)).parent
    command = ["evaluate", str(tmp_path / "out"), str(tmp_path / "t"), "--mask", str(mask)]
    assert main(command) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    lines = captured.out.splitlines()
    assert lines[0] == (
        "1 image: predicted 66.67 % of the pixels, truth 100.00 %; outliers with fx 721.538 px, "
        "baseline 0.54 m"
    )
    assert lines[1].startswith("predicted without truth: 8: ") and "... and 3 more" in lines[1]
    assert lines[2] == f"truth without prediction: 1: {official(tmp_path / 't', 20)}"
    titles, *rows = (re.split(r"\s{2,}", line.strip()) for line in lines[3:])
    table = {row[0]: dict(zip(titles, row[1:], strict=True)) for row in rows}
    assert (table["mae_m"]["all"], table["coverage"]["all"]) == ("0.25", "0.6667")
    assert (table["mae_m"]["moving"], table["imae_per_km"]["moving"]) == ("0.5", "4.762")
    assert (table["abs_rel"]["moving"], table["delta_1"]["moving"]) == ("0.05", "1")
    assert (table["mae_m"]["20-30 m"], table["coverage"]["20-30 m"]) == ("-", "0")
    assert "over 80 m" not in titles
    assert main([*command, "--json"]) == 0
    scores = json.loads(capsys.readouterr().out)["scores"]
    assert scores["schema_version"] == 1 and scores["parts"]["all"]["mae_m"] == 0.25
    assert len(scores["without_truth"]) == 8


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("p", "nowhere"), "nowhere: no such file or folder"),
        (("p", "t"), "no pair"),
        (("p/1.png", "broken.png"), "broken.png: not a complete image"),
    ],
)
def test_the_verb_refuses_in_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    says: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    put(Path("p/1.png"))
    put(Path("t/2.png"))
    Path("broken.png").write_bytes(b"not a PNG")
    assert main(["evaluate", *arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1 and says in captured.err
