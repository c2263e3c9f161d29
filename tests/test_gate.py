# SPDX-License-Identifier: MIT
"""The gate: the main figures of two streets and a real drive must not become worse.

``gate.yaml`` holds them. A change that makes a figure worse than its tolerance fails here. To
accept new figures, run ``python -m tests.test_gate`` and commit the file with the reason.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from densify.config import resolve
from densify.geometry.types import Result
from densify.pipeline.recording import Recording
from densify.pipeline.run import densify as densify_key
from densify.readers import open_sequence
from densify.scores.depth_metrics import depth_scores

TABLE = Path(__file__).with_name("gate.yaml")
DRIVE = "kitti/2011_09_26/2011_09_26_drive_0013_sync"
KEY, WINDOW, CAMERA = 120, 5, "image_02"
STEREO_BASELINE_M = 0.532725  # of the drives of 2011_09_26
RECORDINGS = {"street": "street", "street:crossing": "street:crossing", "drive 0013": DRIVE}

TOLERANCE = {
    "coverage": -0.003,
    "outliers_percent": 0.02,
    "ghosts_percent": 0.02,
    "recall_percent": -0.2,
    "false_percent": 0.0005,
    "error_m": 0.002,
}
"""How much worse a figure may become, by the end of its name; negative where more is better."""


def depth_figures(result: Result) -> dict[str, float]:
    """Coverage and outliers against exact truth, else with the key held out."""
    metrics = result.metrics
    scores = metrics["depth"][CAMERA] if "depth" in metrics else metrics["held_out"][CAMERA]
    found = {"image coverage": metrics["density"][CAMERA]["filled"]}
    for kind in ("measured", "filled"):
        for part in ("all", "moving"):
            score = scores[kind][part]
            found[f"{kind} {part} coverage"] = score["coverage"]
            found[f"{kind} {part} outliers_percent"] = 100 * score["outliers"]
    return {**found, "ghosts_percent": 100 * metrics["ghosts"]["all"]}


def flow_figures(recording: Recording) -> dict[str, float]:
    """Recall, false positives and mean error of the moving points over one sweep of the window."""
    truth, motion = recording.sequence.truth, recording.motion(KEY)
    moves, found, errors_m = [], [], []
    for registered in recording.window(KEY).sweeps[:-1]:
        frame, row = registered.frame, registered.sweep.row
        field = motion.flow(frame, frame + 1)
        true = truth.displacement(frame, frame + 1)[row]
        moves.append(truth.sweep(frame).moving[row])
        found.append(field.moving)
        errors_m.append(np.linalg.norm(field.displacement - true, axis=1)[moves[-1]])
    moving, told = np.concatenate(moves), np.concatenate(found)
    return {
        "flow recall_percent": 100 * float(told[moving].mean()),
        "flow false_percent": 100 * float(told[~moving].mean()),
        "flow error_m": float(np.concatenate(errors_m).mean()),
    }


def densified(spec: str, *methods: str, key: int = KEY) -> tuple[Recording, dict[str, Result]]:
    recording = Recording(
        open_sequence(spec), resolve(None).scored(), WINDOW, [key], looks_around=True
    )
    return recording, densify_key(recording, key, methods, [CAMERA])


def figures(recording: Recording, results: dict[str, Result]) -> dict[str, float]:
    """Return every figure of one recording."""
    found = depth_figures(results["flow"])
    if recording.sequence.truth is not None:
        found |= flow_figures(recording)
    return {name: round(value, 5) for name, value in found.items()}


@pytest.fixture(scope="module")
def drive(test_data) -> tuple[Recording, dict[str, Result]]:
    return densified(str(test_data / DRIVE), "none", "icp", "flow")


@pytest.mark.parametrize("name", RECORDINGS)
def test_no_figure_becomes_worse(name: str, request: pytest.FixtureRequest) -> None:
    spec = RECORDINGS[name]
    made = request.getfixturevalue("drive") if spec == DRIVE else densified(spec, "flow")
    expected, now = yaml.safe_load(TABLE.read_text("utf-8"))[name], figures(*made)
    assert set(now) == set(expected)
    worse = {}
    for figure, was in expected.items():
        tolerance = TOLERANCE[figure.split()[-1]]
        sign = np.sign(tolerance)
        if sign * (now[figure] - was) > abs(tolerance):
            worse[figure] = f"{was} -> {now[figure]}"
    assert not worse


def test_a_real_drive(drive) -> None:
    results = drive[1]
    icp, flow = results["icp"], results["flow"]
    assert flow.frames == tuple(range(115, 126))
    assert flow.metrics["ghosts"]["all"] <= 0.5 * icp.metrics["ghosts"]["all"]
    assert flow.cloud.far.sum() > 100_000 and not icp.cloud.far.any()
    assert flow.cloud.frame.min() < 110 and flow.cloud.frame.max() > 130
    cloud = flow.cloud.select(~flow.cloud.far)
    assert cloud.moving.sum() > 1000
    still = ~cloud.moving
    assert cloud.points[still].tobytes() == cloud.rigid_points[still].tobytes()
    place = np.full((11, cloud.row.max() + 1), -1)
    place[icp.cloud.frame - 115, icp.cloud.row] = np.arange(len(icp.cloud))
    rigid = icp.cloud.points[place[cloud.frame - 115, cloud.row]]
    assert cloud.rigid_points.tobytes() == rigid.tobytes()
    density = {m: r.metrics["density"]["image_02"]["measured"] for m, r in results.items()}
    assert density["flow"] > 2 * density["none"]


def test_a_near_dark_car_is_solid(test_data) -> None:
    """Truth on what moves: disparity of KITTI's stereo benchmark with whole models of its cars."""
    place = test_data / "kitti_stereo"
    drive, truth = place / Path(DRIVE).relative_to("kitti"), place / "truth"
    true_px = cv2.imread(str(truth / "frame10_disparity.png"), cv2.IMREAD_UNCHANGED) / 256
    moving = cv2.imread(str(truth / "frame10_objects.png"), cv2.IMREAD_UNCHANGED) > 0
    recording, results = densified(str(drive), "flow", key=10)
    camera = recording.sequence.cameras[CAMERA]
    disparity_m_px = camera.focal_px * STEREO_BASELINE_M
    true_m = np.divide(disparity_m_px, true_px, out=np.zeros_like(true_px), where=true_px > 0)
    scores = depth_scores(results["flow"].depth[CAMERA], true_m.astype(np.float32), moving, camera)
    for product, part, most_outliers, least_coverage in (
        ("filled", "moving", 0.02, 0.95),
        ("measured", "moving", 0.02, 0.35),
        ("filled", "all", 0.01, 0.93),
        ("filled", "static", 0.0045, 0.92),
        ("measured", "static", 0.002, 0.78),
    ):
        score = scores[product][part]
        assert score["outliers"] < most_outliers and score["coverage"] > least_coverage


def main() -> None:
    """Write the figures as they are now."""
    folder = Path(os.environ["DENSIFY_TEST_DATA"])
    table: dict[str, Any] = {
        name: figures(*densified(str(folder / spec) if spec == DRIVE else spec, "flow"))
        for name, spec in RECORDINGS.items()
    }
    TABLE.write_text(f"# Written by: python -m tests.test_gate\n{yaml.safe_dump(table)}")


if __name__ == "__main__":
    main()
