# SPDX-License-Identifier: MIT
"""The user's depth images on disk: found whatever they are called, read whatever they hold, refused
in one line where they cannot be right, and never mixed with what is measured."""

from __future__ import annotations

import json
import logging
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml

import densify
from densify.config.errors import InputError
from densify.geometry.types import Camera
from densify.outputs.depth_png import read_depth_png, read_stored
from densify.outputs.key_outputs import write_result
from densify.readers.prior_files import PriorFiles
from tests.small_street import KEY, POSES_GIVEN, one_car

CAMERA = Camera("left", 8, 4, np.eye(3), np.eye(4))
VALUE = np.arange(1, 33, dtype=np.float32).reshape(4, 8)
SKY = np.zeros((4, 8), np.uint8)
SKY[0] = 255


def put(path, value=VALUE):
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, value)
    elif path.suffix == ".png":
        assert cv2.imwrite(str(path), value)
    else:
        library = pytest.importorskip("OpenEXR")
        channels = value if isinstance(value, dict) else {"Y": value}
        header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
        library.File(header, channels).write(str(path))


def read(place, number=120, camera=CAMERA):
    return PriorFiles.open(place, [camera.name]).prior(camera, number)


@pytest.mark.parametrize(
    "name",
    ["left/120.npy", "left/0000000120_disp.npy", "left/data/0000000120.npy", "0000000120-depth.npy",
     "120.exr", "left/120.png"],
)  # fmt: skip
def test_files_are_found_by_number(name, tmp_path):
    put(tmp_path / name, VALUE.astype(np.uint16) if name.endswith("png") else VALUE)
    double = (2 * VALUE).astype(np.float32 if name.endswith("exr") else np.uint16)
    put(tmp_path / name.replace("120", "121"), double)
    found = read(tmp_path)
    assert np.array_equal(found.value, VALUE) and found.value.dtype == np.float32
    assert not found.sky.any() and found.source.endswith(name)
    assert np.array_equal(read(tmp_path, 121).value, 2 * VALUE)
    assert read(tmp_path, 122) is None
    alone = PriorFiles.open(tmp_path / name, ["left"])
    assert alone.values == {"left": {120: tmp_path / name}} and alone.sky == {"left": {}}


def test_what_is_no_number_above_0_is_no_value(tmp_path):
    value = VALUE.astype(np.float64)
    value[0, :5] = np.nan, np.inf, -np.inf, -3, 1e300
    put(tmp_path / "120.npy", value)
    found = read(tmp_path).value
    assert not found[0, :5].any() and np.array_equal(found[1:], VALUE[1:])


def test_other_sizes_of_the_same_aspect_are_resized_without_mixing_in_none(tmp_path):
    ramp = np.tile(np.arange(1, 17, dtype=np.float32), (8, 1))
    ramp[:, :4] = 0
    put(tmp_path / "120.npy", ramp)
    found = read(tmp_path).value
    assert found.shape == (4, 8) and not found[:, :2].any()
    np.testing.assert_allclose(found[:, 2:], np.tile(1.5 + 2 * np.arange(2, 8), (4, 1)))


def test_masks_of_the_sky_lie_beside(tmp_path):
    put(tmp_path / "left" / "120.npy")
    put(tmp_path / "flat" / "120.npy")
    put(tmp_path / "flat" / "sky" / "120.png", SKY)
    assert np.array_equal(read(tmp_path / "flat").sky, SKY > 0)
    for mask in (np.repeat(SKY[..., None], 3, 2), SKY.repeat(2, 0).repeat(2, 1)):
        put(tmp_path / "sky" / "left" / "000120.png", mask)
        assert np.array_equal(read(tmp_path).sky, SKY > 0)


BAD = {
    "wrong aspect": ("120.npy", np.ones((4, 9)), "9 x 4 px, expected 8 x 4"),
    "colours": ("120.npy", np.ones((4, 8, 3)), "expected numbers (H,W)"),
    "text": ("120.npy", np.full((4, 8), "far"), "expected numbers (H,W)"),
    "nothing": ("120.npy", np.full((4, 8), np.nan), "no number above 0"),
    "8 bit": ("120.png", np.ones((4, 8), np.uint8), "8 bit of shape (4, 8), expected 16 bit"),
    "16 bit colours": ("120.png", np.ones((4, 8, 3), np.uint16), "one channel"),
    "exr colours": ("120.exr", {"RGB": np.ones((4, 8, 3), "f")}, "expected numbers (H,W)"),
    "exr of many": ("120.exr", {"U": VALUE, "V": VALUE}, "channels U, V, expected one"),
    "torn npy": ("120.npy", b"\x93NUMPY torn", "not a whole .npy"),
    "torn exr": ("120.exr", b"torn", "not a whole EXR"),
    "torn png": ("120.png", b"torn", "not a complete image"),
    "no number": ("mine.npy", VALUE, "mine.npy: names no frame; expected 0000000120.npy"),
    "two of a number": ("000120.npy", VALUE, "has the number 120, as 000120.npy has"),
    "no files": ("left/notes.txt", b"", "no depth images named by frame"),
}


@pytest.mark.parametrize("bad", BAD)
def test_what_cannot_be_right_is_refused(bad, tmp_path):
    name, value, says = BAD[bad]
    if isinstance(value, bytes):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(value)
    else:
        put(tmp_path / name, value)
    if bad == "two of a number":
        put(tmp_path / "120.npy")
    place = tmp_path / name if bad == "no number" else tmp_path
    with pytest.raises(InputError) as error:
        read(place)
    assert says in str(error.value) and str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_flat_folder_is_of_one_camera(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        PriorFiles.open(tmp_path / "nowhere", ["left"])
    put(tmp_path / "120.npy")
    with pytest.raises(InputError, match="one camera, and there are left, right"):
        PriorFiles.open(tmp_path, ["left", "right"])


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The small street without a prior, and with its truth as one, inverse and of another scale."""
    place = tmp_path_factory.mktemp("prior")
    street = one_car()
    true_m = street.truth.depth_m("front", KEY)
    put(place / "front" / f"{KEY:010d}.npy", np.where(true_m > 0, 5 / np.maximum(true_m, 1e-3), 0))
    plain = densify.run(street, KEY, 2, config=POSES_GIVEN)
    full = densify.run(one_car(), KEY, 2, config=POSES_GIVEN, prior=place)
    return SimpleNamespace(place=place, plain=plain, full=full, true_m=true_m)


def test_a_prior_changes_nothing_of_what_is_measured_or_filled(runs, tmp_path):
    for name, result in (("plain", runs.plain), ("full", runs.full)):
        write_result(result, tmp_path / name, config={}, data="tiny")
    plain, full = ({
        p.relative_to(tmp_path / name / "000003").as_posix(): p.read_bytes()
        for p in (tmp_path / name).rglob("*") if p.is_file()
    } for name in ("plain", "full"))  # fmt: skip
    assert set(full) == set(plain) | {"depth_full/front.png", "confidence_full/front.png"}
    for name in set(plain) - {"metrics.json", "run.yaml", "figure.png"}:
        assert plain[name] == full[name], name
    folder = tmp_path / "full" / "000003"
    depth_m = read_depth_png(folder / "depth_full" / "front.png")
    filled_m = read_depth_png(folder / "depth_filled" / "front.png")
    assert np.array_equal(depth_m[filled_m > 0], filled_m[filled_m > 0])
    confidence = read_stored(folder / "confidence_full" / "front.png", np.uint8, "confidence")
    assert np.array_equal(confidence > 0, depth_m > 0)
    assert confidence[(depth_m > 0) & (filled_m == 0)].max() <= 52
    record = yaml.safe_load((folder / "run.yaml").read_text())["prior"]["front"]
    assert record["kind"] == "inverse" and record["used"] and abs(record["scale"] - 0.2) < 0.01
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["density"]["front"]["prior"] == pytest.approx(record["share"])


def test_the_priors_pixels_are_scored_by_themselves(runs):
    full, scores = runs.full.full["front"], runs.full.metrics["depth"]["front"]
    known = runs.true_m > 0
    assert full.from_prior.mean() > 0.1 and full.fit.used
    assert scores["prior"]["all"]["num_compared"] == (full.from_prior & known).sum()
    assert scores["prior"]["all"]["outliers"] < 0.02
    assert scores["full"]["all"]["coverage"] > scores["filled"]["all"]["coverage"] + 0.1
    assert "prior" not in runs.plain.metrics["depth"]["front"]
    sure = full.confidence[runs.full.depth["front"].filled_m > 0]
    assert full.confidence[full.from_prior].max() < sure.min()


def test_a_prior_that_does_not_fit_is_not_used_with_a_warning(tmp_path, caplog):
    noise = np.random.default_rng(0).uniform(1, 9, one_car().truth.depth_m("front", KEY).shape)
    put(tmp_path / f"{KEY}.npy", noise)
    with caplog.at_level(logging.WARNING, "densify"):
        made = densify.run(one_car(), KEY, 1, "none", config=POSES_GIVEN, prior=tmp_path)
    assert any("is not used" in m and f"{KEY}.npy" in m for m in caplog.messages)
    assert np.array_equal(made.full["front"].depth_m, made.depth["front"].filled_m)
