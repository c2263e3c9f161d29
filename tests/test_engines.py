# SPDX-License-Identifier: MIT
"""The table of engines, and what an engine is given."""

from __future__ import annotations

import inspect
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from densify.config import Config
from densify.config.cache import Cache
from densify.config.errors import InputError
from densify.config.plugins import ENGINES, engine
from densify.flow.engines import Scene, check_engine, estimate_motion
from densify.free_space.ground import ground
from densify.geometry.types import Stretch
from tests import scenes


@pytest.fixture(scope="module")
def driving() -> Scene:
    movers = (*scenes.street(), scenes.car(14, -1.6, 10, 1))
    stretch = scenes.Scene(scenes.World(movers), scenes.Arc(0, -1.5, 0, 6.0, 0.0)).stretch(5, 2)
    return Scene(stretch, ground(stretch))


@pytest.mark.parametrize("row", ENGINES.built_in, ids=lambda row: row.name)
def test_every_engine_has_the_one_interface(row) -> None:
    module = row.load_module()
    assert list(inspect.signature(module.estimate_motion).parameters) == [
        "scene",
        "settings",
        "argument",
    ]
    assert engine(row.usage)[0] is row


def test_sweeps_that_are_not_asked_for_tell_what_moves_all_the_same(driving: Scene) -> None:
    frames, config = driving.stretch.frames, Config()
    asked = frames[1:4]
    whole, part = (
        estimate_motion(replace(driving, asked=which), config) for which in (None, asked)
    )
    for frame in frames:
        got, wanted = part.flow(frame, 5), whole.flow(frame, 5)
        assert wanted.moving.any()
        if frame in asked:
            np.testing.assert_array_equal(got.moving, wanted.moving)
            # an object that bends is softened by the points of the sweeps that are asked for
            np.testing.assert_allclose(got.displacement, wanted.displacement, atol=0.02)
        else:
            assert not got.moving.any()
    alone = Scene(Stretch(driving.stretch.sweeps[1:4]), driving.ground)
    few = estimate_motion(alone, config)
    assert any((part.flow(f, 5).total != few.flow(f, 5).total).any() for f in asked)


@pytest.mark.parametrize("row", [r for r in ENGINES.built_in if r.shared], ids=lambda r: r.name)
def test_shared_motion_is_kept_without_points(driving: Scene, row, tmp_path: Path) -> None:
    motion = estimate_motion(driving, Config(), row.usage)
    cache, bare = Cache(folder=tmp_path), motion.with_stretch(Stretch(()))
    cache.get("motion", 1, lambda: bare)
    kept = cache.get("motion", 1, lambda: pytest.fail("not kept"))
    nobody = replace(
        driving.stretch.sweeps[0],
        sweep=driving.stretch.sweeps[0].sweep.select(
            np.zeros(len(driving.stretch.sweeps[0].sweep), bool)
        ),
    )
    again = kept.with_stretch(Stretch((nobody, *driving.stretch.sweeps[1:])))
    got, wanted = again.flow(4, 5), motion.flow(4, 5)
    np.testing.assert_array_equal(got.displacement, wanted.displacement)
    assert wanted.moving.any()


def test_an_engine_that_cannot_work_is_known_before_anything_is_computed() -> None:
    check_engine("groups")
    with pytest.raises(InputError, match=r"flow\.engine: got 'magic', expected one of groups, "):
        check_engine("magic")
    with pytest.raises(InputError, match="npz:nowhere: no such folder"):
        check_engine("npz:nowhere")


@pytest.mark.parametrize("backward", [False, True])
def test_two_sweeps_show_what_moves_to_either_side(driving: Scene, backward: bool) -> None:
    """Both turned by 90 degrees: flow is in each sweep's own axes."""
    turned = np.array([[0.0, -1, 0, 3], [1, 0, 0, -2], [0, 0, 1, 0], [0, 0, 0, 1]])
    sweeps = [
        replace(
            s,
            T_world_lidar=s.T_world_lidar @ turned,
            sweep=replace(s.sweep, points=(s.sweep.points - turned[:3, 3]) @ turned[:3, :3]),
        )
        for s in driving.stretch.sweeps[2:4]
    ]
    pair = replace(driving, stretch=Stretch(tuple(sweeps)))
    here, there = pair.stretch.frames[:: -1 if backward else 1]
    found = estimate_motion(pair, Config(), "pairs").flow(here, there)
    followed = estimate_motion(driving, Config()).flow(here, there)
    both = found.moving & followed.moving
    assert both.sum() > 0.8 * followed.moving.sum() > 100
    for wanted, got in (
        (followed.displacement, found.displacement),
        (followed.to_reference, found.to_reference),
        (followed.velocity_m_s * 0.1, found.velocity_m_s * 0.1),
    ):
        off_m = np.linalg.norm(got[both] - wanted[both] @ turned[:3, :3], axis=1)
        assert np.median(off_m) < 0.03
    assert not found.displacement[~found.moving].any()
