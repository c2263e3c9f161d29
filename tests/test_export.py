# SPDX-License-Identifier: MIT
"""Export of a finished run: exactly the pixels that thresholds leave, the run itself untouched."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

import densify
from densify.config.errors import InputError
from densify.depth.age import with_ages
from densify.geometry.types import Cloud, DepthMap, Result
from densify.outputs import export_run, read_depth_png, write_result
from densify.outputs.atomic import staged_folder

H, W = 12, 20
CAMERAS = ("image_02", "image_03")
PRODUCTS = ("depth", "depth_filled", "confidence", "age")
KEY_NS = 1_782_500_000_123_456_789
LATE_S = 0.01
AGE_S = {119: 0.11, 120: 0.01, 121: 0.09}
STAMPS_NS = {119: KEY_NS - 100_000_000, 120: KEY_NS, 121: KEY_NS + 100_000_000}


def map_of(camera, seed):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((H, W)) < 0.4, rng.uniform(2, 300, (H, W)), 0).astype(np.float32)
    filled = np.where(depth > 0, depth, np.float32(rng.random() * 30))
    filled[0] = depth[0]
    frame = np.where(depth > 0, rng.integers(119, 122, (H, W)), -1).astype(np.int32)
    return with_ages(
        DepthMap(camera, depth, filled, rng.random((H, W), dtype=np.float32), frame),
        STAMPS_NS,
        120,
        LATE_S,
    )


@pytest.fixture
def maps():
    return {name: map_of(name, i) for i, name in enumerate(CAMERAS)}


@pytest.fixture
def run(tmp_path, maps):
    """A finished run's folder."""
    return written(tmp_path, maps)


def written(out, maps):
    cloud = Cloud(
        points=np.zeros((1, 3)),
        rigid_points=np.zeros((1, 3)),
        frame=np.array([120], np.int32),
        since_key_ns=np.zeros(1, np.int64),
        row=np.zeros(1, np.int64),
        lidar=np.zeros(1, np.uint8),
        moving=np.zeros(1, bool),
        instance=np.full(1, -1, np.int32),
        velocity_m_s=np.zeros((1, 3), np.float32),
        confidence=np.ones(1, np.float32),
        intensity=np.ones(1, np.float32),
        rgb=np.zeros((1, 3), np.uint8),
        far=np.zeros(1, bool),
    )
    write_result(Result("flow", 120, tuple(AGE_S), cloud, maps), {}, out, config={}, data="street")
    return out / "000120"


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def maps_in(folder):
    return {name: data for name, data in tree(folder).items() if name.split("/")[0] in PRODUCTS}


def stored(folder, product, camera="image_02"):
    return cv2.imread(str(folder / product / f"{camera}.png"), cv2.IMREAD_UNCHANGED)


def refused(*parts, run, **arguments):
    """In one line that names these parts, and the run stays as it was."""
    before = tree(run)
    with pytest.raises(InputError) as error:
        export_run(run, **arguments)
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert str(part) in message, message
    assert tree(run) == before


# What is kept


def test_maps_of_single_images_lie_in_folders_of_their_cameras(tmp_path):
    names = ("fast/000359", "fast/000360", "fisheye/000120")
    run = written(tmp_path, {name: map_of(name.split("/")[0], i) for i, name in enumerate(names)})
    assert set(maps_in(run)) == {f"{p}/{name}.png" for p in PRODUCTS for name in names}
    export = export_run(run)
    assert set(export.density) == set(names)
    assert maps_in(run / "export") == maps_in(run)


def test_nothing_asked_for_gives_the_same_bytes_and_leaves_the_run_alone(run):
    before = tree(run)
    exported = export_run(run)
    after = tree(run)
    assert {n: d for n, d in after.items() if not n.startswith("export/")} == before
    assert maps_in(run / "export") == maps_in(run)
    assert set(maps_in(run)) == {f"{p}/{c}.png" for p in PRODUCTS for c in CAMERAS}
    assert sorted(exported.paths) == sorted(run / "export" / name for name in tree(run / "export"))
    assert export_run(run, 0.0, 1e6, run.parent / "other").density == exported.density
    assert maps_in(run.parent / "other") == maps_in(run)


@pytest.mark.parametrize(
    ("confidence", "age_ms"), [(0.5, None), (0.8, 100.0), (0.0, 50), (1.0, 0.0), (0.0, 90)]
)
def test_what_is_kept_is_told_by_the_maps_in_memory(run, maps, confidence, age_ms):
    exported = export_run(run, confidence, age_ms)
    for camera, depth in maps.items():
        keep = np.rint(254 * depth.confidence.astype(float)) >= np.rint(254 * confidence)
        if age_ms is not None:
            assert depth.age_s is not None
            keep &= np.rint(1000 * depth.age_s.astype(float)) <= age_ms
        for product in PRODUCTS:
            before = stored(run, product, camera)
            after = stored(run / "export", product, camera)
            assert after.dtype == before.dtype
            np.testing.assert_array_equal(after, np.where(keep, before, 0))
        for product, name in (("measured", "depth"), ("filled", "depth_filled")):
            density = exported.density[camera][product]
            assert density.before == np.count_nonzero(stored(run, name, camera)) / (H * W)
            assert density.after == (
                np.count_nonzero(stored(run / "export", name, camera)) / (H * W)
            )


def test_density_falls_with_each_threshold(run, tmp_path):
    for name, steps in (
        ("min_confidence", np.linspace(0, 1, 9)),
        ("max_age_ms", (200, 110, 109, 90, 89, 10, 9)),
    ):
        kept = []
        for value in steps:
            exported = export_run(run, **{name: value}, out=tmp_path / "x", overwrite=True)
            kept.append([d.after for p in exported.density.values() for d in p.values()])
        falls = np.diff(np.array(kept), axis=0)
        assert (falls <= 0).all()
        assert (falls < 0).any(axis=0).all()


def test_a_pixel_exactly_at_the_threshold_is_kept(run, maps):
    confidence = float(maps["image_02"].confidence[maps["image_02"].filled_m > 0].max())
    assert export_run(run, confidence).density["image_02"]["filled"].after > 0
    exported = export_run(run, 0, 10, run.parent / "x")
    assert stored(run.parent / "x", "age").max() == 11
    assert exported.density["image_02"]["measured"].after > 0


def test_the_record(run):
    exported = export_run(run, 0.5, 100)
    record = yaml.safe_load((run / "export" / "export.yaml").read_text("utf-8"))
    density = record.pop("density")
    assert record == {
        "run": str(run),
        "to": "png",
        "min_confidence": 0.5,
        "max_age_ms": 100.0,
        "version": densify.__version__,
    }
    assert set(density) == set(CAMERAS)
    for camera, products in density.items():
        for product, there in products.items():
            of = exported.density[camera][product]
            assert there == {"before": of.before, "after": of.after}
            assert 0 < of.after < of.before < 1
    export_run(run, 0.5, out=run.parent / "x")
    assert yaml.safe_load((run.parent / "x" / "export.yaml").read_text())["max_age_ms"] is None


# Whole or not at all


def test_an_export_is_kept_or_replaced_whole(run):
    export_run(run, 0.9)
    (run / "export" / "notes.txt").write_text("mine")
    before = tree(run)
    refused(run / "export", "--overwrite", run=run, min_confidence=0.1)
    assert tree(run) == before
    export_run(run, 0.1, overwrite=True)
    assert (run / "export" / "notes.txt").read_text() == "mine"
    assert tree(run / "export") != before


def test_a_damaged_map_leaves_nothing_behind(run):
    path = run / "age" / "image_03.png"  # the last one read
    path.write_bytes(path.read_bytes()[:-20])
    before = tree(run)
    refused(path, "not a complete image", run=run)
    assert tree(run) == before
    refused(path, run=run, out=run.parent / "new" / "x")
    assert not (run.parent / "new").exists()


def test_no_run_is_written_over(run, maps):
    before = tree(run)
    refused("maps would be lost", run=run, out=run, overwrite=True)
    assert tree(run) == before
    (run / "link").symlink_to(run)
    refused("maps would be lost", run=run, out=run / "link", overwrite=True)


def test_a_place_that_cannot_be_written_to(run, monkeypatch):
    refused("not a folder", run=run, out=run / "run.yaml" / "x")
    before = tree(run)

    def full(*_):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("densify.outputs.export.write_file", full)
    refused(os.strerror(28), "nothing was kept", run=run)
    assert tree(run) == before


# Bad input


@pytest.mark.parametrize("value", [-0.01, 1.01, float("nan"), float("inf")])
def test_confidences_out_of_range(run, value):
    refused("--min-confidence", value, "0 to 1", run=run, min_confidence=value)


@pytest.mark.parametrize("value", [-1, float("nan"), float("inf")])
def test_ages_out_of_range(run, value):
    refused("--max-age-ms", value, run=run, max_age_ms=value)


def test_folders_that_are_no_run(run, tmp_path):
    for place in (tmp_path, tmp_path / "absent", run / "run.yaml"):
        refused(place, "no run.yaml", run=place)
    bare = tmp_path / "bare"
    with staged_folder(bare, ()) as folder:
        (folder / "run.yaml").write_text("key: 1\n")
    refused(bare, "no depth maps", run=bare)


@pytest.mark.parametrize("product", PRODUCTS)
def test_a_missing_map_is_named(run, product):
    (run / product / "image_03.png").unlink()
    refused(f"{product}/image_03.png missing", run=run)
    assert not (run / "export").exists()


@pytest.mark.parametrize("product", PRODUCTS)
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "text", "colour", "depth"])
def test_a_damaged_map_is_named_and_nothing_else_is_said(run, product, damage, capfd):
    path = run / product / "image_02.png"
    data = path.read_bytes()
    if damage == "colour":
        cv2.imwrite(str(path), np.zeros((H, W, 3), np.uint8))
    elif damage == "depth":
        wrong = np.uint16 if product == "confidence" else np.uint8
        cv2.imwrite(str(path), np.ones((H, W), wrong))
    else:
        flipped = bytearray(data)
        flipped[len(data) // 2] ^= 4
        other = {"cut": data[: len(data) // 2], "flipped": bytes(flipped), "empty": b""}
        path.write_bytes(other.get(damage, b"hello"))
    whole = damage in ("colour", "depth")
    refused(path, f"expected a map of {product}" if whole else "not a complete image", run=run)
    assert capfd.readouterr() == ("", "")


@given(cut=st.integers(0, 400), flip=st.integers(0, 399), bit=st.integers(0, 7))
def test_any_damage_is_found(cut, flip, bit, tmp_path_factory):
    folder = tmp_path_factory.mktemp("png")
    values = np.random.default_rng(0).integers(0, 65536, (9, 11), np.uint16)
    data = bytearray(cv2.imencode(".png", values)[1].tobytes())
    data[flip % len(data)] ^= 1 << bit
    path = folder / "a.png"
    path.write_bytes(bytes(data)[: max(cut, len(data) // 2)])
    with pytest.raises(InputError, match="not a complete image"):
        read_depth_png(path)


def test_maps_that_do_not_belong_together(run):
    confidence = stored(run, "confidence")
    path = run / "confidence" / "image_02.png"
    cv2.imwrite(str(path), confidence[:, :-1])
    refused(path, f"{W - 1} x {H} px", f"{W} x {H}", run=run)
    row, column = np.argwhere(confidence > 0)[0]
    confidence[row, column] = 0
    cv2.imwrite(str(path), confidence)
    refused(path, "1 pixels", run=run)
    confidence[row, column] = 9
    cv2.imwrite(str(path), confidence)
    depth = stored(run, "depth")
    row, column = np.argwhere(stored(run, "depth_filled") == 0)[0]
    depth[row, column] = 7
    cv2.imwrite(str(run / "depth" / "image_02.png"), depth)
    refused(run / "depth" / "image_02.png", "1 pixels", run=run)


# Ages


@given(seed=st.integers(0, 10**6), share=st.sampled_from([0.02, 0.2, 0.9]))
def test_a_pixel_is_as_old_as_the_nearest_measured_one(seed, share):
    rng = np.random.default_rng(seed)
    depth = np.where(rng.random((H, W)) < share, 5, 0).astype(np.float32)
    depth[rng.integers(H), rng.integers(W)] = 5
    filled = np.where(rng.random((H, W)) < 0.7, 5, depth).astype(np.float32)
    frame = np.where(depth > 0, rng.integers(119, 122, (H, W)), -1).astype(np.int32)
    bare = DepthMap("cam", depth, filled, filled / 5, frame)
    aged = with_ages(bare, STAMPS_NS, 120, LATE_S)
    assert bare.age_s is None and aged.age_s is not None
    assert aged.age_s.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(aged.age_s), filled == 0)
    measured = np.argwhere(depth > 0)
    for row, column in np.argwhere(filled > 0):
        squared = ((measured - (row, column)) ** 2).sum(axis=1)
        near = measured[squared == squared.min()]
        allowed = np.array([AGE_S[int(frame[r, c])] for r, c in near])
        assert abs(allowed - aged.age_s[row, column]).min() < 1e-6
    again = with_ages(bare, STAMPS_NS, 120, LATE_S).age_s
    np.testing.assert_array_equal(again, aged.age_s)


def test_a_map_without_depth_has_no_ages():
    empty = np.zeros((H, W), np.float32)
    aged = with_ages(
        DepthMap("cam", empty, empty, empty, np.full((H, W), -1, np.int32)), STAMPS_NS, 120, 0
    )
    assert aged.age_s is not None and np.isnan(aged.age_s).all()
