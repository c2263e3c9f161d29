# SPDX-License-Identifier: MIT
"""Train one network on several kinds of depth maps, and test it: ``densify bench training``.

Maps, tests and finished rows are kept in a folder, and a repeated call continues. The maps of a
training set are made from its own sweeps alone, none before its first key or after its last one.
"""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from densify.bench.depth import Altered, TruthMap, without_scanner
from densify.bench.gate import KEYS, GateKey, Subject, ip_basic
from densify.config import resolve
from densify.config.cache import Cache
from densify.config.errors import InputError
from densify.depth.exposure import key_shots, load_images
from densify.geometry.types import LidarSequence, Progress
from densify.learning.completion import SIZES, Completion, Sample, predict, train
from densify.outputs.folders import file_aside, write_json
from densify.pipeline.recording import Recording
from densify.pipeline.run import densify
from densify.readers import open_sequence
from densify.readers.timeline import choose_cameras
from densify.scores.metrics import errors_by_part, mean_errors

_WINDOW = 5
_METHODS = ("none", "icp", "icp-visible", "flow")
Arrays = dict[str, Any]


class Part(NamedTuple):
    """Key sweeps of a recording to train on."""

    data: str  # recording; a real one is a path below the folder of recordings
    keys: range  # frame numbers
    cameras: tuple[str, ...] = ("image_02",)
    scanner: int | None = None  # index of the scanner whose returns are kept for the tests

    @property
    def is_real(self) -> bool:
        """True for a real recording, False for a street."""
        return not self.data.startswith("street")


_KITTI = Part("kitti/2011_09_26/2011_09_26_drive_0013_sync", range(100, 132))
_PANDASET = Part("pandaset/002", range(10, 21), ("front_camera", "left_camera"), scanner=1)
_STREETS = (
    Part("street?seed=501", range(50, 71, 4)),
    Part("street:crossing?seed=502", range(50, 71, 4)),
    Part("street:highway?seed=503", range(50, 71, 4)),
)

SETS: Mapping[str, tuple[Part, ...]] = {
    "both": (_KITTI, _PANDASET),
    "streets": _STREETS,
    "KITTI": (_KITTI,),
    "PandaSet": (_PANDASET,),
}
"""Name of a training set -> its key sweeps."""

TESTS: Mapping[str, tuple[GateKey, ...]] = {
    "KITTI, stereo": tuple(key for key in KEYS if key.truth == "stereo"),
    "PandaSet, second scanner": tuple(
        GateKey("pandaset/002", key, "scanner", "front_camera") for key in range(21, 25)
    ),
    "street, exact": (
        GateKey("street?seed=301", 60),
        GateKey("street:crossing?seed=302", 60),
        GateKey("street:highway?seed=303", 60),
    ),
}
"""Name of a test -> keys whose truth it compares with. No network was trained on their sweeps."""

TARGETS: Mapping[str, tuple[str, bool]] = {
    "single sweep held out": ("", False),
    "single sweep IP-Basic": ("ip-basic", False),
    "rigid (ICP)": ("icp", False),
    "rigid cleaned": ("icp-visible", False),
    "densify measured": ("flow", False),
    "densify filled": ("filled", False),
    "densify filled by confidence": ("filled", True),
}
"""Kind of depth maps to train on -> name of the stored map, and True to weigh by confidence."""

UNTRAINED = "nothing"
"""Name of the row of an untrained network."""


class Plan(NamedTuple):
    """The networks to train."""

    sets: Sequence[str] = tuple(SETS)  # names of `SETS`
    targets: Sequence[str] = tuple(TARGETS)  # names of `TARGETS`
    seeds: int = 5  # number of networks of each set and kind of maps
    network: str = "small"  # name in `completion.SIZES`
    steps: int | None = None  # training steps of each network; None for those of its size
    with_returns: bool = True  # False trains on the image alone (monocular depth)
    device: str = "auto"  # "auto", "cpu" or "cuda"


def bench_training(
    folder: Path | None, out: Path, plan: Plan, progress: Progress | None = None
) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Train the networks that are not finished yet, and return the errors of all of the plan.

    Args:
        folder: Folder of the real recordings; None leaves out the sets and tests that need it.
        out: Folder of maps and results.
        plan: The networks to train.
        progress: Callback (stage, done, total).

    Returns:
        Training set -> kind of maps -> for each seed: test -> part of the pixels (as
        `errors_by_part`) -> mean errors over the keys, as a dict of `DepthErrors`.
    """
    for names, known in ((plan.sets, SETS), (plan.targets, TARGETS)):
        if unknown := [name for name in names if name not in known]:
            raise InputError(f"got {unknown[0]!r}, expected some of {'; '.join(known)}")
    sets = [name for name in plan.sets if folder or not SETS[name][0].is_real]
    steps = SIZES[plan.network].steps if plan.steps is None else plan.steps
    plan = plan._replace(sets=sets, steps=steps)
    maps = {name: _make_map_files(SETS[name], folder, out, progress) for name in sets}
    tests = _read_tests(folder, out, progress)
    size = "" if plan.network == "small" else f"-{plan.network}"
    path = out / f"training{size}{'' if plan.with_returns else '-image-alone'}.json"
    stored = _read(path, {"steps": steps, "tests": [*tests]})
    rows: dict[str, Any] = stored["rows"]
    wanted = {
        f"{name} | {target} | {seed}": (name, target, seed)
        for name in sets
        for seed in range(plan.seeds)
        for target in plan.targets
    }
    if UNTRAINED not in rows:
        untrained = Completion(plan.with_returns, plan.network).train(False)
        rows[UNTRAINED] = _errors(untrained, tests)
    read = lru_cache(len(plan.targets))(lambda name, target: _read_samples(maps[name], target))
    for number, (row, (name, target, seed)) in enumerate(wanted.items()):
        if row not in rows:
            rows[row] = _errors(_train(read(name, target), plan, seed, number, progress), tests)
            write_json(path, stored)
    table: dict[str, dict[str, list[dict[str, Any]]]] = {"": {UNTRAINED: [rows[UNTRAINED]]}}
    for row, (name, target, _) in wanted.items():
        table.setdefault(name, {}).setdefault(target, []).append(rows[row])
    return table


def mean_and_error(values: Sequence[float]) -> tuple[float | None, float | None]:
    """Return the mean over seeds, and its standard error, None for too few values."""
    if not values:
        return None, None
    error = float(np.std(values, ddof=1)) / len(values) ** 0.5 if len(values) > 1 else None
    return float(np.mean(values)), error


def _read(path: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Return the finished rows of a file; raise InputError if they are of other steps or tests."""
    if not path.exists():
        return {**about, "rows": {}}
    stored: dict[str, Any] = json.loads(path.read_bytes())
    for name, value in about.items():
        if stored[name] != value:
            raise InputError(
                f"{path}: has networks with {name} {stored[name]}, asked for {value}; choose "
                f"another --out"
            )
    return stored


def _train(
    samples: Sequence[Sample], plan: Plan, seed: int, row: int, progress: Progress | None
) -> Completion:
    """Train the network of a row, and show the progress of all rows."""
    steps = cast(int, plan.steps)
    num_steps = len(plan.sets) * len(plan.targets) * plan.seeds * steps

    def show(step: int) -> None:
        if progress is not None:
            progress("train", row * steps + step, num_steps)

    return train(
        samples,
        steps,
        seed,
        size=plan.network,
        with_returns=plan.with_returns,
        device=plan.device,
        progress=show,
    )


def _make_map_files(
    parts: Sequence[Part], folder: Path | None, out: Path, progress: Progress | None
) -> list[Path]:
    """Make the maps of a training set that are missing, and return the files of all."""
    files = dict[tuple[Part, int, str], Path]()
    for part in parts:
        place = out / "maps" / _file_name(part.data.rpartition("/")[2])
        for key, camera in product(part.keys, part.cameras):
            files[part, key, camera] = place / f"{key:06d}-{camera}.npz"
        missing = [
            key
            for key in part.keys
            if not all(files[part, key, camera].exists() for camera in part.cameras)
        ]
        if not missing:
            continue
        recording = _open(part, folder)
        for number, key in enumerate(missing):
            for camera, arrays in _make_maps(recording, key, part.cameras).items():
                _write_arrays(files[part, key, camera], arrays)
            if progress is not None:
                progress(f"maps of {part.data}", number + 1, len(missing))
    return [*files.values()]


def _file_name(text: str) -> str:
    """Return the text with a dash for everything that a file name should not have."""
    return re.sub(r"\W+", "-", text)


def _write_arrays(path: Path, arrays: Arrays) -> None:
    """Write a compressed ``.npz`` file, which appears when it is complete."""
    with file_aside(path) as aside:
        np.savez_compressed(aside, **arrays)


def _open(part: Part, folder: Path | None) -> Recording:
    """Open the sweeps of a part, without those before its first key and after its last."""
    whole = open_sequence(str(folder / part.data) if folder and part.is_real else part.data)
    sequence = whole if part.scanner is None else without_scanner(whole, part.scanner)
    frames = [frame for frame in whole.frames if part.keys[0] <= frame <= part.keys[-1]]
    own: Any = Altered(sequence, frames=frames)
    return Recording(own, resolve(None), _WINDOW, part.keys, Cache(), looks_around=True)


def _make_maps(recording: Recording, key: int, cameras: Sequence[str]) -> dict[str, Arrays]:
    """Return camera -> image and depth maps of a key, by the names in `TARGETS`."""
    results = densify(recording, key, _METHODS, cameras, with_images=False)
    return {
        camera: {
            "filled": ours.filled_m,
            "confidence": ours.confidence,
            **{method: result.depth[camera].depth_m for method, result in results.items()},
            **_image(recording.sequence, key, camera),
        }
        for camera, ours in results["flow"].depth.items()
    }


def _image(sequence: LidarSequence, key: int, camera: str) -> Arrays:
    """Return the image (H,W,3) that a map of the key shows, and its focal length."""
    shots = key_shots(sequence, choose_cameras(sequence, [camera]), key)
    focal_px = np.float64(sequence.cameras[camera].focal_px)
    return {"image": load_images(sequence, shots)[camera], "focal_px": focal_px}


def _read_samples(files: Sequence[Path], target: str) -> list[Sample]:
    """Return the samples of a training set with depth maps of one kind."""
    samples, (name, by_confidence) = [], TARGETS[target]
    for path in files:
        with np.load(path, allow_pickle=False) as maps:
            sparse_m, weight = maps["none"], maps["confidence"] if by_confidence else None
            depth_m = None  # the single sweep is trained with pixels of its own held out
            if name == "ip-basic":
                depth_m = ip_basic(sparse_m)
            elif name:
                depth_m = maps[name]
            image = maps["image"].transpose(2, 0, 1) / np.float32(255)
            focal_px = float(maps["focal_px"])
        samples.append(Sample.of(image, sparse_m, depth_m, weight, focal_px=focal_px))
    return samples


class _Test(NamedTuple):
    """A key whose true depth is known."""

    sample: Sample
    truth: TruthMap
    focal_px: float


def _read_tests(
    folder: Path | None, out: Path, progress: Progress | None
) -> dict[str, list[_Test]]:
    """Return name of the test -> its keys; their truth is made once and kept."""
    tests: dict[str, list[_Test]] = {}
    chosen = [(name, key) for name, keys in TESTS.items() for key in keys]
    for number, (name, key) in enumerate(chosen):
        if folder is None and key.is_real:
            continue
        path = out / "tests" / f"{_file_name(key.name)}.npz"
        if not path.exists():
            _write_arrays(path, _make_test(key, folder))
        with np.load(path, allow_pickle=False) as kept:
            arrays = dict(kept)
        focal_px = float(arrays["focal_px"])
        image = arrays["image"].transpose(2, 0, 1) / np.float32(255)
        sample = Sample.of(image, arrays["none"], focal_px=focal_px)
        truth = TruthMap(arrays["truth"], arrays["moving"], True, float(arrays["baseline_m"]))
        tests.setdefault(name, []).append(_Test(sample, truth, focal_px))
        if progress is not None:
            progress("tests", number + 1, len(chosen))
    return tests


def _make_test(key: GateKey, folder: Path | None) -> Arrays:
    """Return image, single sweep and truth of a key."""
    subject = Subject.of(key, folder, Cache())
    truth = cast(TruthMap, subject.truth)  # none of these keys is held out
    single = densify(subject.recording, key.key, ["none"], [key.camera], with_images=False)
    return {
        "none": single["none"].depth[key.camera].depth_m,
        "truth": truth.depth_m,
        "moving": truth.moving,
        "baseline_m": np.float64(truth.baseline_m),
        **_image(subject.recording.sequence, key.key, key.camera),
    }


def _errors(network: Completion, tests: Mapping[str, Sequence[_Test]]) -> dict[str, Any]:
    """Return test -> part of the pixels -> mean errors over the keys of the test."""
    errors: dict[str, Any] = {}
    for name, of_test in tests.items():
        by_part = defaultdict(list)
        for sample, truth, focal_px in of_test:
            depth_m = predict(network, sample)
            stereo = {"focal_px": focal_px, "baseline_m": truth.baseline_m}
            of_key = errors_by_part(depth_m, truth.depth_m, truth.moving, **stereo)
            for part, of_part in of_key.items():
                by_part[part].append(of_part)
        errors[name] = {part: asdict(mean_errors(of_keys)) for part, of_keys in by_part.items()}
    return errors
