# SPDX-License-Identifier: MIT
"""The place from which a sweep was measured, found in walls and posts of a street."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from densify.config import resolve
from densify.config.errors import InputError
from densify.free_space.raw_sweeps import is_still, rays_begin_at_poses, way_in_map
from densify.geometry import poses
from densify.pipeline.recording import Recording
from densify.readers import open_sequence
from densify.readers.street import Street

FIRST, LAST = 112, 122  # which other tests render too


@pytest.fixture(scope="module")
def street() -> Street:
    return Street("street", 0, "vlp16", cameras=())


@pytest.fixture(scope="module")
def placed(street):
    """(sweeps, poses) of a second's way, the sweeps in the frame of a map at the first one."""
    frames = [FIRST, LAST]
    T = [poses.inverse(street.T_world_lidar(frames[0])) @ street.T_world_lidar(f) for f in frames]
    sweeps = [street[f] for f in frames]
    moved = [
        replace(s, points=poses.transform(t, s.points)) for s, t in zip(sweeps, T, strict=True)
    ]
    return moved, np.stack(T)


@pytest.mark.parametrize("up_m", [0, 1.8])
def test_the_way_of_the_scanner_in_a_map(street, placed, up_m):
    """The map begins at the scanner, or at the wheels below it."""
    sweeps, T = placed
    sweeps = [replace(sweep, points=sweep.points + [0, 0, up_m]) for sweep in sweeps]
    way_m = np.linalg.norm(T[1, :3, 3])
    assert way_m > 3 and abs(way_in_map(*sweeps) - way_m) < 1.5
    stored = [street[FIRST], street[LAST]]
    assert way_in_map(*(replace(s, points=s.points + [0, 0, up_m]) for s in stored)) == 0
    assert is_still(np.stack([np.eye(4)] * 2)) and not is_still(T)


def test_a_rosette_at_rest_is_in_its_own_frame():
    """Its few returns are hardly occluded from anywhere."""
    resting = Street("crossing", 307, "rosette", cameras=())
    assert way_in_map(resting[40], resting[55]) == 0


def test_sweeps_at_their_poses_are_placed(street, placed):
    sweeps, T = placed
    T_world_map = np.eye(4)
    T_world_map[:3, 3] = 30.0, -20.0, 0.5
    moved = [replace(s, points=poses.transform(T_world_map, s.points)) for s in sweeps]
    assert rays_begin_at_poses(moved, T_world_map @ T)
    assert not rays_begin_at_poses([street[FIRST], street[LAST]], T_world_map @ T)


def test_sweeps_in_the_frame_of_a_map_are_refused_with_the_remedy(placed, street, tmp_path):
    T_map_world = poses.inverse(street.T_world_lidar(FIRST))
    for frame in range(FIRST, FIRST + 5):
        T = T_map_world @ street.T_world_lidar(frame)
        np.save(tmp_path / f"{frame}.npy", poses.transform(T, street[frame].points))
    recording = Recording(open_sequence(tmp_path), resolve({}), window=2)
    with pytest.raises(InputError, match=r"frame of a map.*begin \d\.\d m apart.*frame: poses"):
        recording.window(FIRST + 2)
