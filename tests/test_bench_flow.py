# SPDX-License-Identifier: MIT
"""The flow benchmark: baselines where the answer is known, a tiny window, and the command."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from densify.bench import flow as bench
from densify.bench import pairs as bench_pairs
from densify.bench.baselines import cluster_icp, nonrigid_icp
from densify.bench.memory import PeakMemory
from densify.bench.pairs import Trace, pairs_of
from densify.bench.scoring import Scorer
from densify.bench.windows import Window
from densify.cli import bench_tables as tables
from densify.cli import main
from densify.config import resolve
from densify.config.errors import InputError
from densify.flow.objective.solvers import SolverSettings, solve
from densify.geometry.types import FlowField, Stretch
from densify.scores.segmentation import LEAST_POINTS
from tests.scenes import Arc, Scanner, Scene, TinySequence, World, car, street

CONFIG = resolve({"register": {"source": "dataset"}, "flow": {"look_around_s": 0.0}})
FAST = ("ours", "rigid", "cluster-icp", "nicp")


def shell(size_m: tuple[float, float, float], num: int) -> np.ndarray:
    """Points at random on the six faces of a box about the origin."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (num, 3))
    points[np.arange(num), rng.integers(0, 3, num)] = rng.choice([-0.5, 0.5], num)
    return points * size_m


# --- baselines ------------------------------------------------------------------------------------


def test_nonrigid_icp_bends_a_box():
    source = shell((3.0, 0.8, 0.4), 800)
    bend = np.zeros_like(source)
    bend[:, 2] = 0.06 * source[:, 0] ** 2  # up to 13 cm at the ends
    flow = nonrigid_icp(source, source + bend)
    error, unexplained = flow - bend, bend - bend.mean(0)  # the latter by any translation
    assert np.linalg.norm(unexplained, axis=1).mean() > 0.045
    assert np.linalg.norm(error, axis=1).mean() < 0.025  # what is left slides along the surface


def test_softer_follows_the_bend_more_closely():
    source = shell((3.0, 0.8, 0.4), 800)
    bend = np.zeros_like(source)
    bend[:, 1] = 0.05 * np.sin(2 * source[:, 0])
    error = [
        np.linalg.norm(nonrigid_icp(source, source + bend, alphas) - bend, axis=1).mean()
        for alphas in ((1000.0,), (1000.0, 3.0))
    ]
    assert error[1] < 0.5 * error[0]


def test_nonrigid_icp_leaves_what_does_not_move():
    source = shell((2.0, 1.0, 1.0), 500)
    assert np.abs(nonrigid_icp(source, source)).max() < 1e-6
    alone = np.array([[0.0, 0, 0], [50, 0, 0]])  # no target within reach of the second
    flow = nonrigid_icp(alone, np.array([[0.3, 0, 0]]))
    assert np.isfinite(flow).all()


def test_cluster_icp_moves_each_box_by_its_own_motion():
    box = shell((4.0, 1.8, 1.4), 900)
    c, s = np.cos(0.1), np.sin(0.1)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    moved = [box + [2.4, 0.4, 0], box @ turn.T + [0, 0.3, 0], box]
    places = [np.array(p) for p in ([0.0, 0, 0], [20, 0, 0], [0, 15, 0])]
    source = np.vstack([box + p for p in places])
    goal = np.vstack([m + p for m, p in zip(moved, places, strict=True)])
    order = np.random.default_rng(0).permutation(len(goal))
    error = np.linalg.norm(cluster_icp(source, goal[order], 0.1) - (goal - source), axis=1)
    assert error.max() < 1e-6


def test_cluster_icp_makes_no_mirror_images():
    flat = shell((2.0, 1.0, 0.0), 300)
    flow = cluster_icp(flat, flat + [0.2, 0.1, 0], 0.1)
    assert np.abs(flow - [0.2, 0.1, 0]).max() < 1e-6


@pytest.mark.parametrize("method", [partial(cluster_icp, duration_s=0.1), nonrigid_icp])
@pytest.mark.parametrize("bad", [np.zeros((0, 3)), np.zeros((4, 2)), np.zeros(3)])
def test_baselines_name_bad_clouds(method, bad):
    good = np.zeros((5, 3))
    with pytest.raises(InputError, match="source: got shape"):
        method(bad, good)
    with pytest.raises(InputError, match="target: got shape"):
        method(good, bad)


@pytest.mark.parametrize("stiffnesses", [(), (1.0, 0.0), (-1.0,)])
def test_stiffness_is_positive(stiffnesses):
    with pytest.raises(InputError, match="stiffnesses"):
        nonrigid_icp(np.zeros((5, 3)), np.zeros((5, 3)), stiffnesses)


# --- what is measured -----------------------------------------------------------------------------


def tiny(**options) -> TinySequence:
    movers = (car(6, 1.8, 9, 1), car(25, 1.8, 8, 2, yaw=np.pi))
    scene = Scene(World((*street(40.0), *movers)), Arc(0, -1.5, 0, 5.0), Scanner(32, 450))
    return TinySequence(scene, range(8), **options)


@pytest.fixture(scope="module")
def measured() -> dict:
    return bench.bench_flow(tiny(), 4, 2, CONFIG, (*reversed(FAST), "rigid"), max_points=400)


def test_every_method_has_every_number(measured):
    assert tuple(measured["methods"]) == FAST  # in the table's order, each once
    assert measured["frames"] == [2, 3, 4, 5, 6] and measured["num_pairs"] == 4
    json.dumps(measured, allow_nan=False)
    for name, row in measured["methods"].items():
        for key in ("num_points", "seconds_per_pair", "energy_before", "energy_after"):
            assert row[key] > 0, (name, key)
        assert 0 <= row["step"]["found"] <= 1 and row["step"]["movers_m"] >= 0
        assert set(row["window"]["movers_m_by_hops"]) == {"1", "2"}
        assert row["window"]["radial_velocity"] is None
        assert 0 <= row["window"]["coverage"] <= 1
        assert (
            row["times_seconds"]
            == row["seconds_per_pair"] / (measured["methods"]["ours"]["seconds_per_pair"])
        )


def test_slow_methods_get_the_points_that_are_drawn(measured):
    points = {name: row["num_points"] for name, row in measured["methods"].items()}
    assert points["nicp"] == 400
    assert points["rigid"] == points["cluster-icp"] > 400
    assert points["ours"] > points["rigid"]  # the ground too


def test_rigid_is_the_motion_itself(measured):
    rigid = measured["methods"]["rigid"]
    assert rigid["energy_after"] == rigid["energy_before"]
    step = rigid["step"]
    assert step["movers_m"] == pytest.approx(0.85, abs=0.05)  # 9 and 8 m/s for 0.1 s
    assert step["background_m"] == step["static_objects_m"] or step["static_objects_m"] is None
    assert step["found"] == step["falsely_moving"] == step["dynamic_iou"] == 0
    assert step["bucketed_dynamic"] == pytest.approx(1)
    assert step["found_movers_m"] is None and rigid["window"]["found_movers_m_by_hops"] == {}
    hops = rigid["window"]["movers_m_by_hops"]
    assert hops["2"] == pytest.approx(2 * hops["1"], rel=0.02)


def test_methods_do_what_they_are_for(measured):
    rows = measured["methods"]
    for name in ("ours", "cluster-icp"):
        assert rows[name]["step"]["movers_m"] < 0.5 * rows["rigid"]["step"]["movers_m"], name
        assert rows[name]["window"]["coverage"] > rows["rigid"]["window"]["coverage"], name
    assert rows["ours"]["step"]["background_m"] == 0
    assert 0 < rows["ours"]["step"]["found_movers_m"] <= rows["ours"]["step"]["movers_m"]
    hops = rows["ours"]["window"]
    for n, error_m in hops["found_movers_m_by_hops"].items():
        assert error_m <= hops["movers_m_by_hops"][n] + 1e-9
    assert rows["ours"]["times_error"] == rows["ours"]["times_seconds"] == 1


def test_without_truth_energy_seconds_and_ghosts_are_left():
    found = bench.bench_flow(
        tiny(with_truth=False), 4, 1, CONFIG, ("ours", "rigid"), max_points=600
    )
    for row in found["methods"].values():
        assert set(row["step"]) == {"called_moving"}
        assert row["window"]["ghost_rate"] is not None and "coverage" not in row["window"]
        assert row["times_error"] is None and row["times_seconds"] > 0
    assert found["truth"] is None
    assert "ghosts" in tables.flow_table(found) and "coverage" not in tables.flow_table(found)


def test_one_pair_and_the_solvers_milestones(monkeypatch):
    monkeypatch.setattr(
        bench_pairs,
        "SolverSettings",
        lambda solver: SolverSettings(solver, adam_num_steps=30),
    )
    found = bench.bench_flow(
        tiny(), 4, 1, CONFIG, ("paper", "paper-adam", "ours-pair"), pairs_only=True, max_points=300
    )
    assert found["num_pairs"] == 1 and found["truth"] is None
    for name in ("paper", "paper-adam"):
        row = found["methods"][name]
        assert row["window"] is None and "times_seconds" not in row
        assert row["num_points"] == 300 and row["energy_after"] < 0.9 * row["energy_before"]
        solver = row["solver"]
        assert solver["lowest_energy"] == pytest.approx(row["energy_after"], rel=1e-6)
        assert 0 < solver["seconds_to_lowest"] <= solver["seconds"] <= row["seconds_per_pair"]
        assert 0 <= solver["pairs_as_low_as_other"] <= 1
    assert found["methods"]["paper-adam"]["solver"]["steps"] == 30
    assert found["methods"]["ours-pair"]["step"]["background_m"] < 0.05
    assert "paper-adam: 30 steps in " in tables.flow_table(found)


def test_the_pair_is_the_earlier_neighbour_and_the_key():
    found = bench.bench_flow(tiny(), 4, 1, CONFIG, ("rigid",), pairs_only=True, max_points=100)
    window = Window.open(tiny(), 4, 1, CONFIG)
    pair = pairs_of(window, 100)[3]
    assert found["methods"]["rigid"]["energy_after"] == pair.energy(np.zeros_like(pair.source))
    assert pair.duration_s == pytest.approx(0.1)
    start = bench.bench_flow(tiny(), 0, 1, CONFIG, ("rigid",), pairs_only=True, max_points=100)
    assert start["num_pairs"] == 1 and start["frames"] == [0, 1]


def test_two_sweeps_are_ours_to_compare_with_their_times():
    """Both ways in time: one flow brings a point to the reference time and on to the other's."""
    sequence = tiny()
    for frame, pair in pairs_of(Window.open(sequence, 4, 1, CONFIG), 100).items():
        field, trace = bench_pairs.flow_of_pair("ours-pair", pair, CONFIG)
        assert trace is None and (field.instance == -1).all()
        rows = pair.here.registered.sweep.row
        movers = field.moving & sequence.truth.sweep(frame).moving[rows]
        assert movers.sum() > 50
        true = sequence.truth.displacement(frame, 4)[rows][movers]
        assert np.linalg.norm(field.displacement[movers] - true, axis=1).mean() < 0.1
        late = pair.here.registered.sweep.offset_ns[movers, None] * 1e-9 / pair.duration_s
        error = np.linalg.norm(field.to_reference[movers] + late * true, axis=1)
        assert error.mean() < 0.2 * np.linalg.norm(late * true, axis=1).mean()


def at_half_the_rate(window: Window) -> Window:
    """The same sweeps, twice as long apart."""
    sweeps = [
        replace(s, sweep=replace(s.sweep, stamp_ns=2 * s.sweep.stamp_ns))
        for s in window.stretch.sweeps
    ]
    return replace(window, stretch=Stretch(tuple(sweeps)))


def test_scores_follow_the_stamps():
    sequence = tiny()
    window = Window.open(sequence, 4, 1, CONFIG)
    still = {f: FlowField.zero(len(window.stretch[f].sweep)) for f in window.frames}
    for rate, duration_s in ((window, 0.1), (at_half_the_rate(window), 0.2)):
        scorer = Scorer.of(sequence, rate, (3, 5))
        way_m = np.concatenate(
            [np.linalg.norm(scorer.answers[f].step[window.above[f]], axis=1) for f in (3, 5)]
        )
        assert scorer.step_scores(still)["space_time_angle_rad"] == pytest.approx(
            np.arctan2(way_m, duration_s).mean()
        )
        # Half as fast as they are: 8 and 9 m/s are other buckets than 4 and 4.5 m/s, and two each.
        half = {f: replace(still[f], displacement=scorer.answers[f].step / 2) for f in (3, 5)}
        assert scorer.step_scores(half)["bucketed_dynamic"] == pytest.approx(0.5)
        pair = pairs_of(rate, 100)[3]
        assert pair.duration_s == pytest.approx(duration_s)


def test_the_worst_object_is_the_one_with_most_error():
    """Two cars: the near one, perfect, and the other, half as fast as it is and found in one of two
    sweeps."""
    sequence = tiny()
    window = Window.open(sequence, 4, 1, CONFIG)
    scorer = Scorer.of(sequence, window, (3, 5))
    answers = scorer.answers
    objects = np.unique(answers[3].segment[answers[3].segment >= 0])
    assert len(objects) == 2
    for worst in objects:
        steps = {}
        for frame in window.frames:
            answer = answers[frame]
            its = answer.segment == worst
            steps[frame] = replace(
                FlowField.zero(len(its)),
                displacement=np.where(its[:, None], 0.5, 1.0) * answer.step,
                moving=answer.moving & ~(its & (frame == 5)),
            )
        told = scorer.worst_object(steps)
        speed_m_s = told["speed_m_s"]
        assert min(abs(speed_m_s - 8), abs(speed_m_s - 9)) < 0.1
        assert told["error_m"] == pytest.approx(0.05 * speed_m_s)
        assert told["share_of_error"] == pytest.approx(1)
        counts = [int(((answers[f].segment == worst) & window.above[f]).sum()) for f in (3, 5)]
        assert told["num_returns"] == np.mean(counts)
        assert told["found"] == pytest.approx(counts[0] / sum(counts))
        assert (told["num_sweeps"], told["num_pairs"]) == (2, 2)
        points = window.stretch[4].sweep.points[answers[4].segment == worst]
        assert told["distance_m"] == pytest.approx(np.linalg.norm(points, axis=1).mean(), abs=0.5)


def test_objects_are_the_methods_own_or_what_moves_together():
    """Two cars: told apart by the true labels, and by the space between them; one object if a
    method calls them so."""
    sequence = tiny()
    window = Window.open(sequence, 4, 1, CONFIG)
    scorer = Scorer.of(sequence, window, (3, 5))
    still = {f: FlowField.zero(len(window.stretch[f].sweep)) for f in (3, 5)}
    truths = {f: scorer.answers[f].segment for f in (3, 5)}
    assert {len(np.unique(t[t >= 0])) for t in truths.values()} == {2}
    loose = {f: replace(still[f], moving=t >= 0) for f, t in truths.items()}
    told = {f: replace(loose[f], instance=(t + 7).astype(np.int32)) for f, t in truths.items()}
    as_one = {f: replace(loose[f], instance=np.zeros(len(t), np.int32)) for f, t in truths.items()}
    seen = [t[window.above[f] & (t >= 0)] for f, t in truths.items()]
    large = sum(int((np.bincount(t) >= LEAST_POINTS).sum()) for t in seen)
    assert large > 0
    for steps in (loose, told):
        scores = scorer.segmentation_scores(steps)
        assert scores["moving_iou"] == scores["panoptic_quality"] == 1
        assert (scores["num_found"], scores["num_missed"], scores["num_false"]) == (large, 0, 0)
    assert scorer.segmentation_scores(as_one)["panoptic_quality"] < 0.95
    assert scorer.segmentation_scores(still)["moving_iou"] == 0


def test_a_cluster_may_move_as_far_as_its_time_allows():
    box = shell((4.0, 1.8, 1.4), 900)
    far = np.array([6.0, 0.0, 0.0])  # beyond 3.6 m, and beyond its own length
    assert np.linalg.norm(cluster_icp(box, box + far, 0.2) - far, axis=1).mean() < 0.1
    assert np.linalg.norm(cluster_icp(box, box + far, 0.1) - far, axis=1).mean() > 1.0


def test_milestones_are_read_off_the_traces():
    adam = [
        Trace((9.0, 5.0, 3.0, 4.0), (0.5, 1.0, 2.0, 3.0)),
        Trace((9.0, 7.0, 6.0, 2.0, 8.0, 8.0), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)),
    ]
    milestones = bench._milestones(adam)
    assert milestones["steps"] == pytest.approx(4) and milestones["seconds"] == pytest.approx(4.5)
    assert milestones["steps_to_lowest"] == pytest.approx(2.5)
    assert milestones["seconds_to_lowest"] == pytest.approx((2 + 4) / 2)
    assert milestones["lowest_energy"] == pytest.approx(2.5)

    def ending_at(*energies: float) -> list[Trace]:
        return [Trace((9.0, energy), (0.0, 0.1)) for energy in energies]

    both = bench._as_low(adam, ending_at(5.5, 6.0))
    assert both["seconds_to_others_lowest"] == pytest.approx((1 + 3) / 2)
    assert both["pairs_as_low_as_other"] == 2
    once = bench._as_low(adam, ending_at(5.5, 1.0))
    assert once == {"seconds_to_others_lowest": 1.0, "pairs_as_low_as_other": 1}
    never = bench._as_low(adam, ending_at(1.0, 1.0))
    assert never == {"seconds_to_others_lowest": None, "pairs_as_low_as_other": 0}


def tiny_pair(max_points: int) -> bench_pairs.Pair:
    return pairs_of(Window.open(tiny(), 4, 1, CONFIG), max_points)[5]


def test_energy_is_the_solvers():
    pair = tiny_pair(90)
    solution = solve(pair.drawn, pair.target_drawn)
    assert len(pair.drawn) == len(pair.target_drawn) == 90
    flow = pair.carried(solution.flow)
    flow[pair.here.drawn] = solution.flow  # they carry to themselves but for rounding
    assert pair.energy(flow) == pytest.approx(solution.energy, rel=1e-9)
    assert pair.energy(np.zeros_like(pair.source)) == pytest.approx(solution.energies[0], rel=1e-9)


def test_flow_is_carried_to_the_points_that_were_not_drawn():
    pair = tiny_pair(300)
    own = np.cos(pair.drawn)
    carried = pair.carried(own)
    assert carried.shape == pair.source.shape
    assert np.abs(carried[pair.here.drawn] - own).max() < 1e-3
    constant = pair.carried(np.tile([1.0, 2, 3], (300, 1)))
    assert constant == pytest.approx(np.tile([1.0, 2, 3], (len(pair.source), 1)))
    whole = tiny_pair(0)
    assert whole.carried(whole.source) is whole.source


def test_a_pairs_flow_becomes_that_of_the_whole_sweep():
    pair = tiny_pair(100)
    registered = pair.here.registered
    R = registered.T_world_lidar[:3, :3]
    assert pair.duration_s == pytest.approx(-0.1)
    fast = np.arange(len(pair.source)) % 2 == 0
    field = pair.as_field(np.where(fast[:, None], [0.3, 0.4, 0.0], [0.04, 0.0, 0.0]))
    assert (field.moving[pair.here.above] == fast).all() and not field.moving[
        ~pair.here.above
    ].any()
    assert field.displacement[field.moving] @ R.T == pytest.approx(
        np.tile([0.3, 0.4, 0.0], (fast.sum(), 1))
    )
    # Backwards in time: what was measured 20 ms late has moved a fifth of the way from the next.
    late = registered.sweep.offset_ns * 1e-9 / 0.1
    assert field.to_reference == pytest.approx(late[:, None] * field.displacement)


def test_memory_counts_what_is_held_for_a_moment():
    memory = PeakMemory.start()
    if memory.before_mb is None:
        pytest.skip("this system does not tell the peak of resident memory")
    held = np.ones(40_000_000 // 8)
    del held
    rise_mb = memory.rise_mb()
    assert rise_mb is not None and 30 < rise_mb < 80


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"methods": ("ours", "magic")}, "--methods magic: expected all, or of ours"),
        ({"methods": ()}, "--methods: got none"),
        ({"window": 0}, "--window 0"),
        ({"max_points": 49}, "--max-points 49"),
        ({"key": 99}, "--key 99: no such frame"),
    ],
)
def test_bad_input_is_named(options, words):
    arguments = {"key": 4, "window": 1, "config": CONFIG} | options
    with pytest.raises(InputError, match=words):
        bench.bench_flow(tiny(), **arguments)


# --- the command ----------------------------------------------------------------------------------

COMMAND = ["bench", "flow", "--data", "street?sensor=vlp16", "--window", "1", "--max-points", "300"]


def test_the_command_prints_tables_and_writes_numbers(tmp_path: Path, capsys, monkeypatch):
    seen: list[tuple] = []

    def measure(sequence, key, *arguments):
        seen.append((sequence.name, key, *arguments[2:5]))
        return bench_flow(tiny(), 4, 1, CONFIG, arguments[2], max_points=arguments[4])

    bench_flow = bench.bench_flow
    monkeypatch.setattr(bench, "bench_flow", measure)
    out = tmp_path / "new" / "flow.json"
    command = [*COMMAND, "--methods", "rigid,ours", "--key", "3", "--key", "5", "--out", str(out)]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == str(out)
    assert printed.count("\nrigid ") == 10 and printed.count("\nours ") == 10
    assert [s[1:] for s in seen] == [(k, ["rigid", "ours"], False, 300) for k in (3, 5)]
    numbers = json.loads(out.read_text("utf-8"))
    assert [len(run["methods"]) for run in numbers["runs"]] == [2, 2]
    assert main(command) == 2  # kept
    assert "--overwrite" in capsys.readouterr().err


def test_default_methods_leave_out_the_minutes():
    assert bench.ADAM in bench.METHODS and bench.ADAM not in bench.DEFAULT_METHODS


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--methods", "magic"], "--methods magic"),
        (["--data", "/no/such/place"], "no such folder"),
        (["--key", "999"], "--key 999: no such frame"),
        (["--out", "table.txt"], "ends in .json"),
        (["--window", "0"], "--window 0"),
        (["--set", "flow.engine=magic"], "flow.engine"),
    ],
)
def test_errors_of_the_command_are_one_line(extra, words, capsys, caplog):
    with caplog.at_level(logging.ERROR, "densify"):
        assert main([*COMMAND, *extra]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and len(captured.err.splitlines()) == 1 and words in captured.err


@pytest.mark.parametrize("command", [["bench"], ["bench", "magic"]])
def test_bench_wants_to_know_what(command, capsys):
    with pytest.raises(SystemExit) as end:
        main(command)
    assert end.value.code == 2 and "densify: " in capsys.readouterr().err
