# SPDX-License-Identifier: MIT
"""Flow of a whole recording in other programs' forms, and true flow read for scoring."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from writers import write_street

from densify.bench.flow import bench_flow
from densify.cli import main
from densify.config import resolve
from densify.config.errors import InputError
from densify.geometry.types import Stretch
from densify.readers import open_sequence
from densify.readers.flow_files import read_labelled_flow
from densify.readers.street import Street
from tests.command import files_in
from tests.exact_motion import registered

feather = pytest.importorskip("pyarrow.feather")
arrow = pytest.importorskip("pyarrow")

FRAMES = (59, 60, 61)
AXES = ("flow_tx_m", "flow_ty_m", "flow_tz_m")
GIVEN = ["--set", "register.source=dataset"]


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """A street as an Argoverse 2 log of three sweeps, with its truth; the second sweep has two rows
    at its end that are no returns."""
    log = write_street(
        "argoverse2",
        Street("street", 0, "vlp16", cameras=()),
        tmp_path_factory.mktemp("val"),
        FRAMES,
    )
    path = sweep_files(log)[1]
    table = feather.read_table(path, memory_map=False)
    empty = table.slice(0, 2).to_pydict() | {axis: np.full(2, np.nan, np.float16) for axis in "xyz"}
    feather.write_feather(arrow.concat_tables([table, arrow.table(empty, table.schema)]), path)
    return log


def sweep_files(log: Path) -> list[Path]:
    return sorted((log / "sensors" / "lidar").iterdir())


def flow(log: Path, out: Path, *more: str) -> int:
    return main(["flow", "--data", str(log), *more, *GIVEN, "--out", str(out)])


@pytest.fixture(scope="module")
def submission(log, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("av2")
    assert flow(log, out, "--all", "--format", "av2") == 0
    return out


def test_a_submission_has_a_file_for_each_sweep_and_a_row_for_each_point(log, submission):
    files = sorted((submission / log.name).iterdir())
    assert [p.name for p in files] == [p.name for p in sweep_files(log)]
    num_moving, truth = 0, open_sequence(log).truth
    for frame, (path, sweep) in enumerate(zip(files, sweep_files(log), strict=True)):
        table = feather.read_table(path)
        types = [str(t) for t in table.schema.types]
        assert (table.column_names, types) == (["is_valid", *AXES], ["bool", *3 * ["halffloat"]])
        assert len(table) == len(feather.read_table(sweep)) and all(table["is_valid"].to_pylist())
        residual = np.stack([table[axis].to_numpy() for axis in AXES], axis=1).astype(float)
        moving = residual.any(axis=1)
        num_moving += int(moving.sum())
        if frame + 1 < len(files):
            true = truth.displacement(frame, frame + 1)
            moving = moving[: len(true)]
            error_m = np.linalg.norm(residual[: len(true)] - true, axis=1)
            length_m = np.linalg.norm(true, axis=1)
            assert np.median(error_m[moving]) < 0.25 * np.median(length_m[moving])
    assert num_moving > 100 and not moving.any()  # the last sweep has none to flow to


def test_other_forms_hold_the_same(log, submission, tmp_path):
    h5py = pytest.importorskip("h5py")
    assert flow(log, tmp_path, "--keys", "0:2", "--format", "opensceneflow") == 0
    assert flow(log, tmp_path, "--keys", "0:2") == 0
    names = ["000000_000001.npz", "000001_000002.npz", f"{log.name}.h5"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    stems = [path.stem for path in sweep_files(log)[:2]]
    with h5py.File(tmp_path / names[2]) as groups:
        assert list(groups) == stems
        first, pose = groups[stems[0]], [np.asarray(groups[stem]["pose"]) for stem in stems]
        columns = ("row", "flow_instance_id", "flow", "ego_motion")
        rows, ids, total, ego_motion = (np.asarray(first[name]) for name in columns)
    np.testing.assert_allclose(np.linalg.inv(pose[1]) @ pose[0], ego_motion, atol=1e-5)
    with np.load(tmp_path / names[0]) as file:
        residual, moving = file["residual_flow"], file["moving"]
        np.testing.assert_array_equal(file["row"], rows)
        np.testing.assert_array_equal(file["object"] >= 0, ids > 0)
        np.testing.assert_allclose(file["total_flow"], total, atol=1e-5)
    table = feather.read_table(submission / log.name / f"{stems[0]}.feather")
    submitted = np.stack([table[axis].to_numpy() for axis in AXES], axis=1)[rows]
    assert moving.sum() > 50
    np.testing.assert_array_equal(residual.astype(np.float16), submitted)


def labels_of(log: Path, folder: Path) -> Path:
    """The exact truth in the form of Argoverse 2's labels, by number; every object is a car."""
    truth = open_sequence(log).truth
    (folder / log.name).mkdir(parents=True)
    for frame, sweep in enumerate(sweep_files(log)[:-1]):
        num_rows = len(feather.read_table(sweep))
        true, instance = np.zeros((num_rows, 3), np.float32), np.full(num_rows, -1)
        exact = truth.displacement(frame, frame + 1)
        true[: len(exact)], instance[: len(exact)] = exact, truth.sweep(frame).instance
        columns = dict(zip(AXES, true.T.copy(), strict=True))
        columns["is_valid"] = np.ones(num_rows, bool)
        columns["classes_0"] = np.where(instance >= 0, 18, -1).astype(np.int8)
        feather.write_feather(arrow.table(columns), folder / log.name / f"{frame:010d}.feather")
    return folder


def test_labels_score_as_the_truth_they_are_made_of(log, tmp_path, capsys):
    labels = labels_of(log, tmp_path / "labels")
    command = ["bench", "flow", "--data", str(log), "--key", "2", "--window", "2", *GIVEN]
    command += ["--methods", "ours,rigid"]
    assert main([*command, "--truth", str(labels), "--json"]) == 0
    scored = json.loads(capsys.readouterr().out)["runs"][0]
    assert scored["num_pairs"] == 2
    exact = bench_flow(
        open_sequence(log), 2, 2, resolve({"register": {"source": "dataset"}}), ("ours", "rigid")
    )
    for name, row in scored["methods"].items():
        labelled, true = row["challenge"], exact["methods"][name]["challenge"]
        assert labelled["three_way"] == pytest.approx(true["three_way"], abs=1e-5)
        assert labelled["bucketed"]["CAR"] == pytest.approx(true["bucketed"]["OBJECT"], abs=1e-5)
    rigid, ours = (scored["methods"][name]["challenge"] for name in ("rigid", "ours"))
    assert rigid["bucketed"]["CAR"]["dynamic"] == pytest.approx(1.0)
    assert rigid["three_way"]["foreground_dynamic_m"] > 0.3
    assert ours["three_way"]["foreground_static_m"] < 1e-4


def test_moving_masks_by_the_reader_of_semantic_kitti_api(log, tmp_path):
    """As its evaluate_mos.py reads and scores them: semantic-kitti-mos.yaml maps 251 to moving and
    9 to static, and both count."""
    assert flow(log, tmp_path, "--all", "--format", "semantickitti") == 0
    folder = tmp_path / "sequences" / log.name / "predictions"
    assert sorted(p.name for p in folder.iterdir()) == [f"{f:06d}.label" for f in range(3)]
    truth, counts = open_sequence(log).truth, np.zeros((3, 3), int)
    look_up = np.zeros(360, int)
    look_up[[9, 251]] = 1, 2
    for frame, sweep in enumerate(sweep_files(log)):
        label = np.fromfile(folder / f"{frame:06d}.label", dtype=np.int32)
        assert len(label) == len(feather.read_table(sweep))
        found, moving = look_up[label & 0xFFFF], truth.sweep(frame).moving
        assert set(np.unique(found)) == {1, 2}
        assert ((label >> 16 > 0) <= (found == 2)).all()
        np.add.at(counts, (found[: len(moving)], 1 + moving), 1)
    iou = counts[2, 2] / (counts[2].sum() + counts[:, 2].sum() - counts[2, 2])
    assert iou > 0.6, counts


def test_doc_depths_exchange_format(tmp_path):
    """Read as DOC-Depth's FORMAT.md and renderer do: classes up to 50 ground, up to 100 static,
    then dynamic; poses bring frames together."""
    plyfile, spec = pytest.importorskip("plyfile"), "street?sensor=vlp16"
    options = ["--keys", "59:61", "--format", "doc-depth", *GIVEN, "--out", str(tmp_path)]
    assert main(["flow", spec, *options]) == 0
    (run,) = tmp_path.iterdir()
    street = open_sequence(spec)

    def vertices(name: str):
        return plyfile.PlyData.read(run / name)["vertex"]

    path = vertices("traj_odometry.ply").data
    assert path["indices"].tolist() == [59, 60]
    T_world_lidar, num_dynamic = np.tile(np.eye(4), (2, 1, 1)), 0
    for T, row in zip(T_world_lidar, path, strict=True):
        frame, quaternion = int(row["indices"]), [row[f"q_{axis}"] for axis in "xyzw"]
        assert quaternion == [row[f"q{axis}"] for axis in "xyzw"]
        np.testing.assert_allclose(row["timestamp"], street.stamp_ns(frame) * 1e-9)
        T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
        T[:3, 3] = [row[axis] for axis in "xyz"]
        ply = vertices(f"frames/frame_{frame:06d}.ply")
        assert [p.val_dtype for p in ply.properties] == ["f4", "f4", "f4", "u2"]
        kind = np.digitize(ply["classid"], [50, 100])  # ground, static, dynamic
        assert (kind == 0).mean() > 0.2 and 0.05 < (kind == 1).mean() < 0.8
        num_dynamic += int((kind == 2).sum())
        assert max(np.abs(ply[axis]).max() for axis in "xyz") < 130
    assert num_dynamic > 50
    first, last = (street.T_world_lidar(frame) for frame in (59, 60))
    step = np.linalg.inv(T_world_lidar[0]) @ T_world_lidar[1]
    np.testing.assert_allclose(step, np.linalg.inv(first) @ last, atol=1e-6)
    camera = street.cameras["image_02"]
    np.testing.assert_array_equal(json.loads((run / "calib.json").read_text())["mtx"], camera.K)
    np.testing.assert_array_equal(np.loadtxt(run / "calib_lidar_ref_cam.txt"), camera.T_cam_lidar)
    exposures = vertices("traj_camera.ply").data
    exposed_s = np.array([*street.image_stamps_ns("image_02").values()]) * 1e-9
    beside_s = np.abs(exposures["timestamp"][:, None] - exposed_s).min(axis=1)
    assert len(exposures) > 1 and beside_s.max() < 1e-6
    np.testing.assert_allclose(exposed_s[exposures["indices"]], exposures["timestamp"], atol=1e-6)


def test_what_is_there_is_kept(log, submission, capsys):
    before = files_in(submission)
    assert flow(log, submission, "--all", "--format", "av2") == 2
    assert "already there and kept" in capsys.readouterr().err
    assert before == files_in(submission)


def test_labels_by_number_and_what_is_wrong_with_them(log, tmp_path):
    points = open_sequence(log)[0].points[:5]
    stretch = Stretch(tuple(registered(frame, points) for frame in (0, 1)))
    labels, empty = labels_of(log, tmp_path / "labels"), tmp_path / "empty"
    path = labels / log.name / "0000000000.feather"
    feather.write_feather(feather.read_table(path, memory_map=False).slice(0, 3), path)
    empty.mkdir()
    for folder, name, words in (
        (tmp_path / "none", "x", "no such folder"),
        (empty, "x", "holds no labels of x"),
        (labels, log.name, "holds 3 labels"),
    ):
        with pytest.raises(InputError, match=words):
            read_labelled_flow(folder, name, stretch, 0)
    np.savez(empty / "000005_000006.npz", residual_flow=np.zeros((9, 3)))
    with pytest.raises(InputError, match="no such flow file"):
        read_labelled_flow(empty, "x", stretch, 0)
    number = np.arange(30)
    columns = {"object": number - 1, "valid": number % 2 == 0}
    np.savez(empty / "000000_000001.npz", residual_flow=np.ones((30, 3)), **columns)
    label, row = read_labelled_flow(empty, "x", stretch, 0), stretch.sweeps[0].sweep.row
    np.testing.assert_array_equal(label.valid, row % 2 == 0)
    np.testing.assert_array_equal(label.classes > 0, row > 0)
