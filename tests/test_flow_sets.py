# SPDX-License-Identifier: MIT
"""Flow of a whole recording in other programs' forms, and true flow read for scoring."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from writers import write_street

from densify.bench.flow import bench_flow
from densify.cli import main
from densify.config import resolve
from densify.config.errors import InputError
from densify.readers import open_sequence
from densify.readers.flow_files import labelled_flow
from densify.readers.street import Street
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
        assert table.column_names == ["is_valid", *AXES]
        assert [str(t) for t in table.schema.types] == [
            "bool",
            "halffloat",
            "halffloat",
            "halffloat",
        ]
        assert len(table) == len(feather.read_table(sweep)) and all(table["is_valid"].to_pylist())
        residual = np.stack([table[axis].to_numpy() for axis in AXES], axis=1).astype(float)
        moving = residual.any(axis=1)
        num_moving += int(moving.sum())
        if frame + 1 < len(files):
            true = truth.displacement(frame, frame + 1)
            residual, moving = residual[: len(true)], moving[: len(true)]
            error_m = np.linalg.norm(residual - true, axis=1)
            length_m = np.linalg.norm(true, axis=1)
            assert np.median(error_m[moving]) < 0.25 * np.median(length_m[moving])
    assert num_moving > 100 and not moving.any()  # the last sweep has none to flow to


def test_other_forms_hold_the_same(log, submission, tmp_path):
    h5py = pytest.importorskip("h5py")
    assert flow(log, tmp_path, "--keys", "0:2", "--format", "opensceneflow") == 0
    assert flow(log, tmp_path, "--keys", "0:2") == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "000000_000001.npz",
        "000001_000002.npz",
        f"{log.name}.h5",
    ]
    with h5py.File(tmp_path / f"{log.name}.h5") as groups:
        assert list(groups) == [p.stem for p in sweep_files(log)[:2]]
        group = groups[sweep_files(log)[0].stem]
        rows, ids = np.asarray(group["row"]), np.asarray(group["flow_instance_id"])
        total = np.asarray(group["flow"])
    with np.load(tmp_path / "000000_000001.npz") as file:
        residual, moving = file["residual_flow"], file["moving"]
        np.testing.assert_array_equal(file["row"], rows)
        np.testing.assert_array_equal(file["object"] >= 0, ids > 0)
        np.testing.assert_allclose(file["total_flow"], total, atol=1e-5)
    table = feather.read_table(submission / log.name / sweep_files(log)[0].name)
    submitted = np.stack([table[axis].to_numpy() for axis in AXES], axis=1)[rows]
    assert moving.sum() > 50
    np.testing.assert_array_equal(residual.astype(np.float16), submitted)


def labels_of(log: Path, folder: Path, by_number: bool) -> Path:
    """The exact truth in the form of Argoverse 2's labels; every object is a car."""
    truth = open_sequence(log).truth
    (folder / log.name).mkdir(parents=True)
    for frame, sweep in enumerate(sweep_files(log)[:-1]):
        num_rows = len(feather.read_table(sweep))
        true, instance = np.zeros((num_rows, 3), np.float32), np.full(num_rows, -1)
        exact = truth.displacement(frame, frame + 1)
        true[: len(exact)], instance[: len(exact)] = exact, truth.sweep(frame).instance
        columns = dict(zip(AXES, true.T.copy(), strict=True))
        columns |= {"is_valid": np.ones(num_rows, bool)}
        columns |= {"classes_0": np.where(instance >= 0, 18, -1).astype(np.int8)}
        name = f"{frame:010d}.feather" if by_number else sweep.name
        feather.write_feather(arrow.table(columns), folder / log.name / name)
    return folder


def test_labels_score_as_the_truth_they_are_made_of(log, tmp_path, capsys):
    labels = labels_of(log, tmp_path / "labels", by_number=True)
    command = ["bench", "flow", "--data", str(log), "--key", "2", "--window", "2", *GIVEN]
    command += ["--methods", "ours,rigid"]
    assert main([*command, "--truth", str(labels), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["runs"][0]
    assert found["num_pairs"] == 2
    exact = bench_flow(
        open_sequence(log), 2, 2, resolve({"register": {"source": "dataset"}}), ("ours", "rigid")
    )
    for name, row in found["methods"].items():
        here, there = row["challenge"], exact["methods"][name]["challenge"]
        assert here["three_way"] == pytest.approx(there["three_way"], abs=1e-5)
        assert here["bucketed"]["CAR"] == pytest.approx(there["bucketed"]["OBJECT"], abs=1e-5)
    rigid, ours = (found["methods"][name]["challenge"] for name in ("rigid", "ours"))
    assert rigid["bucketed"]["CAR"]["dynamic"] == pytest.approx(1.0)
    assert rigid["three_way"]["foreground_dynamic_m"] > 0.3
    assert ours["three_way"]["foreground_static_m"] < 1e-4


# --- what is refused ------------------------------------------------------------------------------


def test_what_is_there_is_kept(log, submission, capsys):
    before = {p: p.read_bytes() for p in (submission / log.name).iterdir()}
    assert flow(log, submission, "--all", "--format", "av2") == 2
    assert "already there and kept" in capsys.readouterr().err
    assert before == {p: p.read_bytes() for p in (submission / log.name).iterdir()}


def test_bad_labels_are_named(log, tmp_path):
    points = open_sequence(log)[0].points[:5]
    stretch_of = [registered(frame, points) for frame in (0, 1)]
    from densify.geometry.types import Stretch

    stretch = Stretch(tuple(stretch_of))
    with pytest.raises(InputError, match="no such folder"):
        labelled_flow(tmp_path / "none", "x", stretch, 0)
    with pytest.raises(InputError, match="holds no labels of x"):
        labelled_flow(tmp_path, "x", stretch, 0)
    labels = labels_of(log, tmp_path / "labels", True)
    path = labels / log.name / "0000000000.feather"
    table = feather.read_table(path, memory_map=False)
    feather.write_feather(table.slice(0, 3), path)
    with pytest.raises(InputError, match="holds 3 labels"):
        labelled_flow(labels, log.name, stretch, 0)
    shutil.rmtree(labels / log.name)
    np.savez(tmp_path / "000005_000006.npz", residual_flow=np.zeros((9, 3)))
    with pytest.raises(InputError, match="no such flow file"):
        labelled_flow(tmp_path, "x", stretch, 0)
    np.savez(
        tmp_path / "000000_000001.npz",
        residual_flow=np.ones((30, 3)),
        object=np.arange(30) - 1,
        valid=np.arange(30) % 2 == 0,
    )
    label = labelled_flow(tmp_path, "x", stretch, 0)
    row = stretch.sweeps[0].sweep.row
    np.testing.assert_array_equal(label.valid, row % 2 == 0)
    np.testing.assert_array_equal(label.classes > 0, row > 0)
