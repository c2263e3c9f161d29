# SPDX-License-Identifier: MIT
"""What the screen says of results."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from densify.cli import results as said
from densify.geometry import types


def result_with(metrics: dict[str, Any], method: str, num_points: int) -> types.Result:
    depth_m = np.zeros((4, 5), np.float32)
    depth_m[0, 0] = 3
    filled_m = np.where(np.arange(20).reshape(4, 5) < 10, 3, 0).astype(np.float32)
    depth = types.DepthMap("cam", depth_m, filled_m, filled_m / 3, np.full((4, 5), -1, np.int32))
    n = num_points
    cloud = types.Cloud(
        points=np.zeros((n, 3)),
        rigid_points=np.zeros((n, 3)),
        frame=np.zeros(n, np.int32),
        since_key_ns=np.zeros(n, np.int64),
        row=np.arange(n),
        lidar=np.zeros(n, np.uint8),
        moving=np.arange(n) < 2,
        instance=np.full(n, -1, np.int32),
        velocity_m_s=np.zeros((n, 3), np.float32),
        confidence=np.ones(n, np.float32),
        intensity=np.ones(n, np.float32),
        rgb=np.zeros((n, 3), np.uint8),
        far=np.zeros(n, bool),
    )
    return types.Result(method, 7, (6, 7, 8), cloud, {"cam": depth}, metrics)


def test_summary_says_the_numbers() -> None:
    text = said.summary(result_with({"ghosts": {"all": 0.0123}}, "icp", 1234))
    assert text.splitlines() == [
        "key 7, icp: 1,234 points of 3 sweeps (6-8), 2 on moving objects",
        "cam: depth in 5.0 % of the pixels, 50.0 % with filled ones",
        "ghosts: 1.23 % of the accumulated points",
    ]
    assert "ghosts" not in said.summary(result_with({"ghosts": {"all": None}}, "none", 2))


def test_comparison_table_is_aligned_and_complete() -> None:
    errors = {"coverage": 0.5, "mae_m": 0.25, "rmse_m": 1.0, "outliers": 0.0625}
    nothing = dict.fromkeys(errors)
    truth = {"cam": {"measured": {"all": errors, "moving": nothing, "static": errors}}}
    alone = {"cam": {"measured": {"all": errors | {"rmse_m": 2.0}}}}
    metrics = {"ghosts": {"all": 0.02}, "depth": truth, "held_out": alone}
    results = {
        "none": result_with(
            {"ghosts": {"all": None}, "depth": truth, "held_out": None}, "none", 10
        ),
        "icp": result_with(metrics, "icp", 1000),
        "flow": result_with({"ghosts": {"all": 0.001}, "depth": truth}, "flow", 999),
    }
    lines = said.comparison(results).splitlines()
    cells = [re.split(r"\s{2,}", line) for line in lines]
    rows = {title: values for title, *values in cells}
    assert rows["points"] == ["10", "1,000", "999"]
    assert rows["ghost rate"] == ["-", "2.00 %", "0.10 %"]
    assert rows["cam truth, all, MAE"] == ["0.250 m"] * 3
    assert rows["cam truth, static, outliers"] == ["6.25 %"] * 3
    assert rows["cam truth, moving, coverage"] == ["-"] * 3
    assert rows["cam key held out, all, RMSE"] == ["-", "2.000 m", "-"]
    assert rows["cam key held out, static, RMSE"] == ["-"] * 3
    assert len({len(line) for line in lines if line}) == 1
    without = {m: result_with({"ghosts": {"all": 0.0}}, m, 5) for m in ("none", "icp", "flow")}
    assert "MAE" not in said.comparison(without)


def test_summary_compares_the_key_held_out_with_registration_alone() -> None:
    def scored(**outliers: float | None) -> dict[str, Any]:
        parts = {part: {"outliers": value} for part, value in outliers.items()}
        return {"ghosts": {"all": 0.01}, "held_out": {"cam": {"measured": parts}}}

    icp = result_with(scored(all=0.02, moving=0.3), "icp", 9)
    flow = result_with(scored(all=0.01, moving=0.05), "flow", 9)
    last = said.summary(replace(flow, baselines={"icp": icp})).splitlines()[-1]
    assert last == (
        "cam, key held out: 1.00 % wrong (2.00 % by registration alone), "
        "5.00 % wrong (30.00 % by registration alone) where it moves"
    )
    still = result_with(scored(all=0.01, moving=None), "icp", 9)
    assert said.summary(still).splitlines()[-1] == "cam, key held out: 1.00 % wrong"
    nothing = result_with({"ghosts": {"all": 0.01}, "held_out": None}, "none", 9)
    assert "held out" not in said.summary(nothing)


def test_movers_apart_are_counted_beside_the_rest() -> None:
    result = result_with({}, "flow", 1234)
    still = replace(result.cloud, moving=np.zeros(1234, bool))
    movers = {i: types.Mover(result.cloud.select(result.cloud.frame == 0), {}) for i in (0, 3)}
    text = said.summary(replace(result, cloud=still, movers=movers))
    num = 2 * int((result.cloud.frame == 0).sum())
    assert f"(6-8), {num:,} more apart, on 2 moving objects" in text and num > 0
