# SPDX-License-Identifier: MIT
"""`run` and `compare` on a small street: recorded poses, movers, scores, and bad arguments."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from densify.config.errors import ComputationError, InputError
from densify.geometry import poses
from densify.geometry.types import Cloud, Reason, Result
from densify.outputs.cloud_files import read_cloud
from densify.outputs.depth_png import read_depth_png
from densify.outputs.key_outputs import write_result
from densify.pipeline.run import compare, run
from tests.scenes import ROOM, Arc, Scanner, Scene, TinySequence, World, by_flow
from tests.small_street import KEY, POSES_GIVEN, one_car
from tests.tiny_street import same_points


def with_movers(word: str, **output) -> Result:
    config = POSES_GIVEN | {"output": {"movers": word, **output}}
    return by_flow(one_car(), KEY, 1, config=config)


NPZ = {"output": {"flow": "npz"}}


@pytest.fixture(scope="module")
def kept() -> Result:
    """With its baselines."""
    output = {"score": True, "rejected": True}
    return run(one_car(), KEY, 1, config=POSES_GIVEN | {"output": output})


@pytest.fixture(scope="module")
def apart() -> Result:
    return with_movers("separate", flow="npz", optical_flow=True)


def rows_of(*clouds: Cloud) -> list[tuple[int, int]]:
    return sorted(
        pair for c in clouds for pair in zip(c.frame.tolist(), c.row.tolist(), strict=True)
    )


# --- movers ---------------------------------------------------------------------------------------


def test_map_and_movers_together_are_the_whole(kept, apart):
    assert kept.cloud.moving.sum() > 1000 and not kept.movers
    movers = [mover.cloud for mover in apart.movers.values()]
    assert sorted(apart.movers) == np.unique(kept.cloud.instance[kept.cloud.moving]).tolist()
    assert rows_of(apart.cloud, *movers) == rows_of(kept.cloud)
    for instance, mover in apart.movers.items():
        mine = kept.cloud.select(kept.cloud.instance == instance)
        assert mine.points.tobytes() == mover.cloud.points.tobytes()
        assert mover.cloud.moving.all() and (mover.cloud.instance == instance).all()
    assert not apart.cloud.moving.any()


def test_dropped_movers_are_nowhere(apart):
    dropped = with_movers("drop")
    assert not dropped.movers and same_points(dropped.cloud, apart.cloud)
    for name in ("depth_m", "filled_m", "confidence", "frame", "age_s"):
        a, b = (getattr(r.depth["front"], name) for r in (dropped, apart))
        assert a.tobytes() == b.tobytes(), name
    assert dropped.metrics == apart.metrics and dropped.metrics["num_moving"] == 0


def test_everything_asked_for_is_written(apart, tmp_path):
    paths = write_result(apart, tmp_path, config=NPZ, data="tiny")
    names = {path.relative_to(tmp_path / "000003").as_posix() for path in paths}
    movers = {
        f"movers/{i:04d}/{name}" for i in apart.movers for name in ("cloud.laz", "depth/front.png")
    }
    flows = {"flow/000002_000003.npz", "flow/000004_000003.npz"}
    optical = {"optical_flow/previous/front.png", "optical_flow/next/front.png"}
    assert movers and movers | flows | optical <= names
    folder = tmp_path / "000003"
    for instance, mover in apart.movers.items():
        where = folder / "movers" / f"{instance:04d}"
        assert len(read_cloud(where / "cloud.laz").points) == len(mover.cloud)
        stored_m = read_depth_png(where / "depth" / "front.png")
        np.testing.assert_allclose(stored_m, mover.depth["front"].depth_m, atol=1 / 512)
    image = cv2.imread(str(folder / "optical_flow" / "next" / "front.png"), cv2.IMREAD_UNCHANGED)
    known = np.isfinite(apart.optical_flow["front"]["next"]).all(axis=2)
    assert np.array_equal(image[..., 0] == 1, known)


# --- the key held out -----------------------------------------------------------------------------


def test_an_exact_static_scene_predicts_its_key():
    scene = Scene(World(ROOM), Arc(0, -1.5, 0, 2.0), Scanner(48, 720))
    results = compare(
        TinySequence(scene, range(5)), 2, 1, config=POSES_GIVEN, methods=("none", "icp")
    )
    assert results["none"].metrics["held_out"] is None
    scores = results["icp"].metrics["held_out"]["front"]["measured"]
    assert scores["all"]["num_compared"] > 2000 and scores["all"]["coverage"] > 0.5
    assert scores["all"]["outliers"] < 0.001 and scores["all"]["mae_m"] < 0.2
    assert scores["moving"]["num_pixels"] == 0 and scores["moving"]["mae_m"] is None


def test_scores_change_no_map(kept):
    plain = run(one_car(), KEY, 1, config=POSES_GIVEN)
    assert not plain.baselines and plain.metrics["held_out"] is None
    for name, maps in plain.depth.items():
        for product in ("depth_m", "filled_m", "confidence", "age_s"):
            mine, scored = getattr(maps, product), getattr(kept.depth[name], product)
            np.testing.assert_array_equal(mine, scored)
    same = ("num_points", "num_moving", "density", "ghosts", "expected_outliers")
    assert all(plain.metrics[score] == kept.metrics[score] for score in same)


def test_flow_predicts_movers_better_than_registration(kept):
    methods = {**kept.baselines, "flow": kept}
    assert methods["none"].metrics["held_out"] is None
    held = {m: methods[m].metrics["held_out"]["front"]["measured"] for m in ("icp", "flow")}
    for scores in held.values():
        assert scores["all"]["num_pixels"] > 2000 and scores["moving"]["num_pixels"] > 200
        split = scores["moving"]["num_pixels"] + scores["static"]["num_pixels"]
        assert split == scores["all"]["num_pixels"]
    assert held["flow"]["moving"]["mae_m"] < 0.3 * held["icp"]["moving"]["mae_m"]
    assert held["flow"]["moving"]["mae_m"] < 0.1
    assert json.loads(json.dumps(held, allow_nan=False)) == held


# --- what is left out -----------------------------------------------------------------------------


def test_every_point_is_accounted_for_and_a_map_says_what_was_left_out(kept, tmp_path):
    counts, maps = kept.metrics["rejected"]["front"], kept.depth["front"]
    assert sum(counts.values()) == len(kept.cloud)
    assert 0 < counts["kept"] <= (maps.depth_m > 0).sum()  # a spot may cover several pixels
    left_out = kept.rejected["front"]
    shown = {Reason(r).name.lower() for r in np.unique(left_out) if r}
    assert shown and shown <= {"hidden", "unsupported", "edge"}
    for name in shown:
        assert (left_out == Reason[name.upper()]).sum() <= counts[name]
    write_result(kept, tmp_path, config=NPZ, data="street")
    path = tmp_path / f"{KEY:06d}" / "scene" / "reason" / "front.png"
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), left_out)


# --- what is given --------------------------------------------------------------------------------


class Jumping(TinySequence):
    """Its recorded poses jump by 30 m at some frames."""

    def __init__(self, jumps) -> None:
        super().__init__(one_car(()).scene, range(7))
        self.jumps = jumps

    def T_world_lidar(self, frame):
        T = super().T_world_lidar(frame)
        T[0, 3] += 30.0 * self.jumps(frame)
        return T


def test_recorded_poses_are_taken_as_they_are_and_checked():
    sequence = one_car(())
    cloud = run(sequence, KEY, 1, "icp", config=POSES_GIVEN).cloud
    mine = cloud.frame == KEY + 1
    T_key_world = poses.inverse(sequence.T_world_lidar(KEY))
    true = poses.transform(T_key_world, sequence.scene.scan(KEY + 1).world)
    near = np.linalg.norm(sequence[KEY + 1].points, axis=1) >= 2.8
    np.testing.assert_allclose(cloud.points[mine], true[near][cloud.row[mine]], atol=0.02)
    moved_m = (T_key_world @ sequence.T_world_lidar(KEY + 1))[:3, 3]
    assert np.linalg.norm(moved_m) == pytest.approx(0.4, abs=0.01)

    once = run(Jumping(lambda frame: frame > KEY), KEY, 2, "icp", config=POSES_GIVEN)
    assert once.frames == (KEY - 2, KEY - 1, KEY)
    assert f"frame {KEY} to {KEY + 1}" in once.warnings[0]
    with pytest.raises(ComputationError, match="registration jumps"):
        run(Jumping(lambda frame: frame % 2), KEY, 2, "icp", config=POSES_GIVEN)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"key": 99}, "key 99"),
        ({"key": 3.0}, r"key 3\.0: expected a frame's number"),
        ({"key": [3]}, "key .3.: expected a frame's number"),
        ({"window": True}, "window True"),
        ({"cameras": 5}, "cameras: got 5, expected a list of names, such as .'front'."),
        ({"window": -2}, "window -2"),
        ({"cameras": ["back"]}, "camera back.*front"),
        ({"config": {"objective": {"alhpa": 1}}}, "alpha"),
        ({"method": "paper"}, "method paper: expected one of none, icp, flow"),
        ({"methods": ("icp", "magic")}, "methods magic: expected some of none, icp, "),
        ({"methods": []}, "methods: got no name, expected some of none, icp, "),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_read(arguments, message):
    sequence = one_car(())
    with pytest.raises(InputError, match=message) as caught:
        make = compare if "methods" in arguments else run
        make(sequence, **{"key": KEY, "window": 1, **arguments})
    assert "\n" not in str(caught.value)
    assert not sequence.read
