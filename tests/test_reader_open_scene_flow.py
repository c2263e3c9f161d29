# SPDX-License-Identifier: MIT
"""OpenSceneFlow's files: a street written as one, broken ones, and flow taken out of them."""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from writers import write_street
from writers.excerpt import Excerpt

import densify
from densify.config.errors import InputError
from densify.geometry.poses import transform
from densify.geometry.types import Trajectory
from densify.outputs.flow_writers import write_flow_h5
from densify.readers import open_sequence
from densify.readers.open_scene_flow import FlowLabels, OpenSceneFlow, SweepFile
from densify.readers.street import Street
from densify.registration.deskew import deskew
from tests.reader_checks import check_refused, check_sweeps, check_truth
from tests.scenes import by_flow
from tests.small_street import KEY, one_car

h5py = pytest.importorskip("h5py")

FRAMES = (59, 60, 61)
POSES_GIVEN = {"register": {"source": "dataset"}}


@pytest.fixture(scope="module")
def excerpt():
    return Excerpt.of(Street("street", 0, "vlp16"), FRAMES, ())


@pytest.fixture(scope="module")
def folder(excerpt, tmp_path_factory):
    out = tmp_path_factory.mktemp("opensceneflow")
    return write_street("opensceneflow", excerpt.street, out, FRAMES)


@pytest.fixture
def copy(folder, tmp_path):
    """A file to be changed."""
    return shutil.copy(folder / "street.h5", tmp_path / "street.h5")


def names(path):
    return SweepFile(path).names


def test_the_street_is_given_back(folder, excerpt):
    sequence = open_sequence(folder)
    assert isinstance(sequence, OpenSceneFlow) and not sequence.cameras
    # between the poses of the sweeps the vehicle's path is taken for straight
    check_sweeps(sequence, excerpt, point_m=0.01, offset_ns=8)
    check_truth(sequence, excerpt)


def test_a_file_or_a_folder_of_files(folder, tmp_path):
    for name in ("a", "b"):
        shutil.copy(folder / "street.h5", tmp_path / f"{name}.h5")
    assert open_sequence(tmp_path / "a.h5").name == "a"
    assert open_sequence(f"opensceneflow:{tmp_path}#b").name == "b"
    with pytest.raises(InputError, match=r"holds 2 recordings; choose one by .*one of a, b"):
        open_sequence(tmp_path)


def test_two_scanners_keep_their_places(tmp_path):
    street = Street("static", 0, "dual32", cameras=())
    sweep = open_sequence(write_street("opensceneflow", street, tmp_path, [60]))[0]
    np.testing.assert_array_equal(sweep.lidar, street[60].lidar)
    np.testing.assert_allclose(sweep.scanner_origins, street[60].scanner_origins)


@pytest.mark.parametrize("unit_ns", [1, 1_000, 1_000_000])
def test_the_unit_of_the_stamps_is_found(copy, unit_ns):
    stamps_ns = SweepFile(copy).stamps_ns
    with h5py.File(copy, "r+") as file:
        for ns in stamps_ns:
            file.move(str(ns), f"new{ns // unit_ns}")
        for name in list(file):
            file.move(name, name.removeprefix("new"))
    assert SweepFile(copy).stamps_ns == stamps_ns


def test_files_without_the_optional_data(copy, folder):
    with h5py.File(copy, "r+") as file:
        for name in names(copy):
            for absent in ("lidar_dt", "lidar_id", "lidar_center", "ground_mask"):
                del file[name][absent]
            rows = file[name]["lidar"][:, :3]
            del file[name]["lidar"]
            file[name]["lidar"] = rows
    sweep, whole = open_sequence(copy)[1], open_sequence(folder)[1]
    assert sweep.offset_ns is None and sweep.scanner_origins is None
    assert len(sweep) == len(whole) and not sweep.intensity.any()
    # left at the stamp, where the vehicle's own motion carried them
    away_m = np.linalg.norm(sweep.points - whole.points, axis=1)
    assert 0.1 < away_m.max() < 1.5


# Flow


def registered(sequence):
    sweeps = [sequence[frame] for frame in sequence.frames]
    trajectory = Trajectory(
        tuple(sequence.frames),
        np.array([s.stamp_ns for s in sweeps]),
        np.stack([sequence.T_world_lidar(s.frame) for s in sweeps]),
    )
    return deskew(sweeps, trajectory)


def test_labels_are_the_true_flow(folder, excerpt):
    sequence = open_sequence(folder)
    stretch, truth = registered(sequence), excerpt.street.truth
    labels = FlowLabels(SweepFile(folder / "street.h5"), "flow", stretch)
    for here, there in ((0, 1), (1, 2)):
        field = labels.step(here, there)
        true = truth.displacement(FRAMES[here], FRAMES[there])
        fast = np.linalg.norm(true, axis=1) > 0.06
        assert fast.sum() > 100 and (field.moving == fast).mean() > 0.99
        np.testing.assert_allclose(field.displacement[fast], true[fast], atol=1e-4)
        assert not field.displacement[~field.moving].any()
        assert (field.instance[field.moving] >= 0).all()
        # to the reference time, and on to the next sweep: where the truth has the point
        at_stamp = stretch.sweeps[here].sweep.points + field.to_reference
        apart_m = np.linalg.norm(at_stamp - truth.sweep(FRAMES[here]).points, axis=1)
        assert np.percentile(apart_m[fast], 90) < 0.05


def test_backwards_the_flow_of_what_arrives_is_reversed(folder, excerpt):
    stretch, truth = registered(open_sequence(folder)), excerpt.street.truth
    labels = FlowLabels(SweepFile(folder / "street.h5"), "flow", stretch)
    field = labels.step(2, 1)
    true = truth.displacement(FRAMES[2], FRAMES[1])
    fast = np.linalg.norm(true, axis=1) > 0.06
    assert (field.moving & fast).sum() > 0.8 * fast.sum()
    assert (field.moving & ~fast).sum() < 0.2 * fast.sum()
    off_m = np.linalg.norm(field.displacement - true, axis=1)[field.moving & fast]
    assert np.median(off_m) < 0.05


def test_densified_with_the_labels_movers_lie_on_each_other(folder, excerpt):
    file = folder / "street.h5"
    config = POSES_GIVEN | {"flow": {"engine": f"opensceneflow:{file}"}}
    sequence = open_sequence(file)
    cloud = by_flow(sequence, 1, 1, config=config).cloud
    rigid = densify.run(sequence, 1, 1, method="icp", config=POSES_GIVEN).cloud
    truth = excerpt.street.truth
    T = [sequence.T_world_lidar(n) for n in range(3)]
    for number in (0, 2):
        mine = (cloud.frame == number) & cloud.moving
        true = truth.sweep(FRAMES[number]).points + truth.displacement(FRAMES[number], FRAMES[1])
        there = transform(np.linalg.inv(T[1]) @ T[number], true[cloud.row[mine]])
        off_m = np.linalg.norm(cloud.points[mine] - there, axis=1)
        left_m = np.linalg.norm(rigid.points[mine] - there, axis=1)
        assert mine.sum() > 100 and np.median(off_m) < 0.05 < 0.3 < np.median(left_m)


def test_our_flow_is_written_as_such_a_file_and_read_again(tmp_path):
    sequence = one_car()
    config = POSES_GIVEN | {"output": {"flow": "opensceneflow"}, "project": {"visibility": False}}
    ours = by_flow(sequence, KEY, 2, config=config)
    path = tmp_path / "flow.h5"
    write_flow_h5(path, ours.flow)
    with h5py.File(path, "r+") as file:
        groups = [file[name] for name in sorted(file, key=int)]
        assert ["flow" in group for group in groups] == [True, True, True, False, False]
        for group, frame in zip(groups, range(KEY - 2, KEY + 3), strict=True):
            assert group.name == f"/{sequence.stamp_ns(frame)}"
            np.testing.assert_array_equal(group["row"][:], ours.flow.stretch[frame].sweep.row)
        for name in list(file)[3:]:
            del file[name]
    read = open_sequence(path)
    labels = FlowLabels(SweepFile(path), "flow", registered(read))
    for here in (0, 1):
        field, step = labels.step(here, here + 1), ours.flow.steps[KEY - 2 + here, KEY - 1 + here]
        assert step.moving.sum() > 50
        np.testing.assert_array_equal(field.moving, step.moving)
        np.testing.assert_allclose(
            field.displacement[step.moving], step.total[step.moving], atol=1e-4
        )
        assert (field.instance[step.moving] == step.instance[step.moving]).all()


# Damage


def on_group(change, number=0):
    def harm(path):
        with h5py.File(path, "r+") as file:
            change(file[sorted(file, key=int)[number]])

    return harm


def sets(name, make):
    def change(group):
        value = make(group[name][:]) if name in group else make(None)
        if name in group:
            del group[name]
        group[name] = value

    return on_group(change)


DAMAGE = {
    "truncated": (lambda p: p.write_bytes(p.read_bytes()[:9000]), "not a whole HDF5 file"),
    "points absent": (on_group(lambda g: g.pop("lidar")), "lidar: absent"),
    "times too short": (sets("lidar_dt", lambda a: a[:-1]), "expected numbers of shape"),
    "pose no rotation": (sets("pose", lambda a: a * 2), "not a rotation"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_refused_in_a_line(copy, damage):
    harm, says = DAMAGE[damage]
    harm(copy)
    check_refused(copy, says, copy)


def test_the_flow_of_another_recording_is_refused(copy, folder):
    sets("lidar", lambda a: a[:99])(copy)
    stretch = registered(open_sequence(folder))
    sets("flow", lambda a: a[:99])(copy)
    for name in ("flow_is_valid", "flow_instance_id"):
        sets(name, lambda a: a[:99])(copy)
    with pytest.raises(InputError, match="give the file that --data names"):
        FlowLabels(SweepFile(copy), "flow", stretch).step(0, 1)
    with pytest.raises(InputError, match="no such file"):
        densify.run(
            open_sequence(folder), 1, 1, config={"flow": {"engine": "opensceneflow:nowhere.h5"}}
        )
