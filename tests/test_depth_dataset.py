# SPDX-License-Identifier: MIT
"""The training set read back: values, geometry under crops and flips, workers, and bad sets."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import densify
from densify.config.errors import InputError
from densify.dataset.loader import DepthDataset
from densify.dataset.manifest import FileRecord, KeyRecord
from densify.dataset.plan import Recipe, plan, write_plan
from densify.geometry.types import DepthMap
from densify.outputs.depth_png import stored_confidence
from densify.outputs.kitti_tree import write_key

W, H = 60, 24
K = np.array([[50.0, 0.25, 27.0], [0, 48.0, 10.0], [0, 0, 1]])
VAL, TRAIN = "2011_09_26_drive_0013_sync", "2011_09_26_drive_0001_sync"
FRAMES = {VAL: (3, 5, 8), TRAIN: (0, 2)}
CAMERAS = ("image_02", "image_03")
KINDS = ("velodyne_raw", "groundtruth", "groundtruth_filled", "confidence")


def words(array):
    return " ".join(f"{value:.17g}" for value in np.ravel(array))


def write_recording(date: Path, drive: str, rng: np.random.Generator) -> dict:
    """A KITTI raw drive of as little as opens; (camera, frame) -> image (H,W,3) RGB."""
    P = words(np.column_stack([K, np.zeros(3)]))
    sizes = [f"S_rect_{c[-2:]}: {W} {H}\nP_rect_{c[-2:]}: {P}\n" for c in CAMERAS]
    sweeps = date / drive / "velodyne_points" / "data"
    sweeps.mkdir(parents=True)
    (date / "calib_cam_to_cam.txt").write_text(f"R_rect_00: {words(np.eye(3))}\n" + "".join(sizes))
    (date / "calib_velo_to_cam.txt").write_text(f"R: {words(np.eye(3))}\nT: 0 0 0\n")
    images = {}
    for frame in FRAMES[drive]:
        (sweeps / f"{frame:010d}.bin").write_bytes(np.ones(4, "<f4").tobytes())
        for camera in CAMERAS:
            image = rng.integers(0, 256, (H, W, 3), dtype=np.uint8)
            path = date / drive / camera / "data" / f"{frame:010d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), image[:, :, ::-1])
            images[camera, frame] = image
    return images


def maps_of(camera: str, rng: np.random.Generator) -> tuple[DepthMap, DepthMap]:
    """Of the key sweep alone, and of all sweeps."""
    filled_m = np.where(rng.random((H, W)) < 0.6, rng.uniform(2, 80, (H, W)), 0)
    filled_m = (np.rint(256 * filled_m) / 256).astype(np.float32)
    dense_m = np.where(rng.random((H, W)) < 0.7, filled_m, np.float32(0))
    sparse_m = np.where(rng.random((H, W)) < 0.1, dense_m, np.float32(0))
    confidence, frame = rng.random((H, W), dtype=np.float32), np.zeros((H, W), np.int32)
    sparse, dense = (
        DepthMap(camera, depth_m, filled_m, confidence, frame) for depth_m in (sparse_m, dense_m)
    )
    return sparse, dense


def line_of(drive: str, frame: int, status: str = "done", cameras=CAMERAS) -> bytes:
    tree = f"{'val' if drive == VAL else 'train'}/{drive}/proj_depth"
    paths = [f"{tree}/{k}/{c}/{frame:010d}.png" for k in KINDS for c in cameras]
    files = dict.fromkeys(paths, FileRecord.of(b"")) if status == "done" else {}
    return KeyRecord(drive, frame, status, files=files).to_line()


@pytest.fixture
def made(tmp_path):
    """A set of two drives, one of each split; its recordings are under ``tmp_path/raw``."""
    rng = np.random.default_rng(5)
    root, date = tmp_path / "set", tmp_path / "raw" / "2011_09_26"
    maps, images, lines = {}, {}, []
    for drive, frames in FRAMES.items():
        recorded = write_recording(date, drive, rng)
        images |= {(drive, *where): image for where, image in recorded.items()}
        for frame in reversed(frames):
            lines.append(line_of(drive, frame))
            pairs = {name: maps_of(name, rng) for name in CAMERAS}
            maps |= {(drive, name, frame): pair for name, pair in pairs.items()}
            sparse, dense = ({name: pair[i] for name, pair in pairs.items()} for i in (0, 1))
            write_key(root / ("val" if drive == VAL else "train") / drive, frame, sparse, dense)
    write_plan(root, Recipe(), plan([str(date / drive) for drive in FRAMES], None, Recipe()))
    about = json.loads((root / "dataset.json").read_text())
    for drive in about["drives"].values():  # with the skew that KITTI's calibration lacks
        drive["cameras"] = {n: {**c, "K": K.tolist()} for n, c in drive["cameras"].items()}
    (root / "dataset.json").write_text(json.dumps(about))
    (root / "manifest.jsonl").write_bytes(b"".join(lines))
    return SimpleNamespace(root=root, date=date, maps=maps, images=images)


def where_of(sample) -> tuple[str, str, int]:
    return sample["drive"], sample["camera"], int(sample["frame"])


# What is read


@pytest.mark.parametrize("filled", [False, True])
def test_every_value_comes_back(made, filled):
    dataset = densify.DepthDataset(made.root, filled=filled)
    assert [where_of(s) for s in dataset] == sorted(made.maps)
    for sample in dataset:
        sparse, dense = made.maps[where_of(sample)]
        dense_m = dense.filled_m if filled else dense.depth_m
        levels = stored_confidence(dense.confidence)
        certain = np.where(dense_m > 0, (levels - 1.0) / 254, 0)
        image = made.images[where_of(sample)].transpose(2, 0, 1)
        np.testing.assert_array_equal(sample["sparse_depth_m"][0], sparse.depth_m)
        np.testing.assert_array_equal(sample["dense_depth_m"][0], dense_m)
        np.testing.assert_allclose(sample["confidence"][0], certain, atol=1e-6)
        np.testing.assert_allclose(sample["image"], image / 255, atol=1e-6)
        np.testing.assert_array_equal(sample["intrinsics"], K.astype(np.float32))
        for name in ("image", "sparse_depth_m", "dense_depth_m", "confidence", "intrinsics"):
            assert sample[name].dtype == torch.float32 and sample[name].is_contiguous()


def test_the_least_certain_pixels_are_left_out(made):
    plain = next(iter(densify.DepthDataset(made.root, filled=True)))
    risk = densify.outlier_probability(plain["confidence"].numpy())
    there = plain["dense_depth_m"].numpy() > 0
    most = risk[there].mean() / 2
    dialled = next(iter(densify.DepthDataset(made.root, filled=True, max_outliers=most)))
    kept = dialled["dense_depth_m"].numpy() > 0
    assert 0 < kept.sum() < there.sum() and risk[kept].mean() <= most
    assert risk[kept].max() <= risk[there & ~kept].min()
    for name in ("dense_depth_m", "confidence"):
        np.testing.assert_array_equal(dialled[name].numpy(), np.where(kept, plain[name].numpy(), 0))


def test_which_samples_are_in_the_set(made):
    assert {where_of(s)[1] for s in DepthDataset(made.root, cameras=["image_03"])} == {"image_03"}
    for split, drive in (("val", VAL), ("train", TRAIN)):
        dataset = DepthDataset(made.root, split=split)
        assert len(dataset) == 2 * len(FRAMES[drive])
        assert {where_of(s)[0] for s in dataset} == {drive}
    whole, *shards = (made.root / f"manifest{n}.jsonl" for n in ("", "-1of2", "-2of2"))
    whole.write_bytes(line_of(VAL, 3, cameras=["image_03"]))
    assert [where_of(s) for s in DepthDataset(made.root)] == [(VAL, "image_03", 3)]
    whole.unlink()
    shards[0].write_bytes(line_of(VAL, 5, "failed") + line_of(VAL, 8) + line_of(TRAIN, 0, "aside"))
    shards[1].write_bytes(line_of(VAL, 3))
    dataset = DepthDataset(made.root, cameras=["image_02"])
    assert [where_of(s) for s in dataset] == [(VAL, "image_02", 3), (VAL, "image_02", 8)]


def test_a_recording_that_has_moved(made, tmp_path):
    shutil.move(made.date, tmp_path / "elsewhere")
    with pytest.raises(InputError, match=rf"{VAL}.*data=\{{'{VAL}'"):
        DepthDataset(made.root, split="val")[0]
    moved = DepthDataset(made.root, split="val", data={VAL: tmp_path / "elsewhere" / VAL})
    image = made.images[where_of(moved[0])].transpose(2, 0, 1)
    np.testing.assert_allclose(moved[0]["image"], image / 255, atol=1e-6)


# Crops and flips


def points_by_depth(sample) -> dict[float, np.ndarray]:
    """Depth -> where the pixels of that depth are in the camera, by the sample's intrinsics."""
    depth_m = sample["dense_depth_m"][0].numpy()
    v, u = np.nonzero(depth_m)
    pixels = np.stack([u, v, np.ones(len(u))])
    points = (np.linalg.inv(sample["intrinsics"].double().numpy()) @ pixels) * depth_m[v, u]
    return {z: points[:, depth_m[v, u] == z] for z in np.unique(depth_m[v, u])}


def test_crops_and_flips_keep_every_point_in_its_place(made):
    whole = {where_of(s): points_by_depth(s) for s in DepthDataset(made.root)}
    cut = DepthDataset(made.root, crop=(16, 31), flip=True)
    mirrored = set()
    for sample in (sample for _ in range(3) for sample in cut):
        (_, skew, centre_px), *_ = sample["intrinsics"].tolist()
        step = 1 if skew > 0 else -1
        left = round(K[0, 2] - (centre_px if step == 1 else 31 - 1 - centre_px))
        image = made.images[where_of(sample)][H - 16 :, left : left + 31][:, ::step] / 255
        np.testing.assert_allclose(sample["image"], image.transpose(2, 0, 1), atol=1e-6)
        assert sample["dense_depth_m"].shape == (1, 16, 31)
        for z, points in points_by_depth(sample).items():
            before = whole[where_of(sample)][z]
            if before.shape[1] == 1:  # of two pixels of one depth: which is which?
                np.testing.assert_allclose(points, before * [[step], [1], [1]], atol=1e-4)
        mirrored.add((step, left))
    assert {step for step, _ in mirrored} == {1, -1} and len(mirrored) > 5


def same(a, b) -> bool:
    return all(torch.equal(a[n], b[n]) for n in ("image", "dense_depth_m", "intrinsics"))


def test_a_seed_repeats_crops_and_flips_in_workers_too(made):
    dataset = DepthDataset(made.root, crop=(12, 20), flip=True, cameras=["image_02"])
    loader = DataLoader(dataset, batch_size=2, num_workers=2, multiprocessing_context="fork")

    def drawn(seed: int) -> list:
        torch.manual_seed(seed)
        return list(loader)

    first, again, other = map(drawn, (1, 1, 2))
    assert all(map(same, first, again)) and not all(map(same, first, other))
    assert [n for batch in first for n in batch["frame"].tolist()] == [0, 2, 3, 5, 8]
    assert [name for batch in first for name in batch["drive"]] == 2 * [TRAIN] + 3 * [VAL]


# What is wrong


def refused(root: Path, *words, **options) -> None:
    with pytest.raises(InputError) as error:
        list(DepthDataset(root, **options))
    message = str(error.value)
    assert "\n" not in message and all(str(word) in message for word in words), message


@pytest.mark.parametrize("kind", ["groundtruth", "confidence"])
def test_a_missing_a_damaged_and_a_foreign_map(made, kind):
    path = made.root / "val" / VAL / "proj_depth" / kind / "image_02" / "0000000005.png"
    whole = path.read_bytes()
    for damaged in (whole[: len(whole) // 2], whole[:100] + bytes([whole[100] ^ 1]) + whole[101:]):
        path.write_bytes(damaged)
        refused(made.root, path, "run densify dataset again")
    stored = cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_UNCHANGED)
    assert cv2.imwrite(str(path), stored[:, :-1])
    refused(made.root, path, f"{W - 1} x {H}", f"{W} x {H}")
    path.unlink()
    refused(made.root, path, "run densify dataset again")


def test_sets_and_options_that_cannot_be_used(made):
    refused(made.root, "nothing to load", "cameras image_02, image_03", cameras=["image_07"])
    for crop in ((H + 1, 20), (0, 20)):
        refused(made.root, f"{crop[0]} x 20", f"{H} x {W}", crop=crop)
    path = made.root / "dataset.json"
    about = json.loads(path.read_text())
    for change, words in (
        ({"layout": "densify"}, "--layout kitti-depth"),
        ({"schema_version": 2}, "schema_version 2"),
        ({"drives": {VAL: {"data": "x"}}}, "damaged"),
    ):
        path.write_text(json.dumps({**about, **change}))
        refused(made.root, path, words)
    path.unlink()
    refused(made.root, path, "densify dataset --layout kitti-depth")
