# SPDX-License-Identifier: MIT
"""Measure the main figures of many keys, for judging changes: ``densify bench gate``."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from densify.bench.truth import (
    TruthMap,
    Without,
    agrees_beside,
    exact_truth,
    scanner_truth,
    stereo_truth,
)
from densify.bench.verdicts import Curve, change, curve
from densify.config import resolve
from densify.config.cache import Cache
from densify.config.errors import InputError
from densify.depth.exposure import key_shots, load_images
from densify.depth.moving_bodies import far_inside
from densify.depth.views import HeldOut
from densify.flow.two_clouds import estimate_flow
from densify.geometry import poses
from densify.geometry.types import (
    Bool,
    DepthMap,
    Float,
    Float32,
    LidarSequence,
    Progress,
    Sweep,
    Trajectory,
    Truth,
)
from densify.outputs.atomic import write_file
from densify.pipeline.key_result import METHODS, see
from densify.pipeline.process import Watch
from densify.pipeline.recording import Recording
from densify.pipeline.run import scene_of
from densify.readers import open_sequence
from densify.readers.timeline import choose_cameras
from densify.registration.trajectory import Registration

KINDS = ("depth", "flow", "registration")
_WINDOW = 5
_NUM_DRAWS = 8  # of the pairs
_MOVED_M, _TURNED_DEG = 0.002, 0.01  # luck of a pose
_KEPT = 0.98  # share of the returns, for the luck of registration
_ASIDE_PX = 10  # by which the truth of the stereo benchmark widens posts and signs
_STEREO = "kitti_stereo/truth"
_DRIVE = "2011_09_26/2011_09_26_drive_0013_sync"
_CAR_M, _CAR_REACH_M = (-4.6, -2.2, 0.0), 2.5  # the nearest moving car of the Argoverse 2 pair
_CAR_FLOW_M = (0.83, 0.0, 0.0)  # by its profile, which both sweeps measured


class GateKey(NamedTuple):
    """A key sweep with ground truth."""

    data: str  # Recording; a real one is a path below the folder of recordings
    key: int  # frame number
    truth: str = "exact"  # "exact", "stereo", "scanner" or "held out"
    camera: str = "image_02"  # name of the camera

    @property
    def name(self) -> str:
        """The name of the key in tables, such as ``street:crossing?seed=302@60``."""
        return f"{self.data.removesuffix('_sync').rpartition('drive_')[2]}@{self.key}"

    @property
    def is_real(self) -> bool:
        """True for a key of a real recording."""
        return self.truth != "exact"


# The streets were never used to choose a rule or a number.
KEYS = (
    GateKey(f"kitti_stereo/{_DRIVE}", 10, "stereo"),
    *(GateKey(f"kitti/{_DRIVE}", key, "held out") for key in (104, 112, 120, 128)),
    *(GateKey("pandaset/002", key, "scanner", "front_camera") for key in (15, 17, 19)),
    GateKey("street?seed=301", 60),
    GateKey("street:crossing?seed=302", 60),
    GateKey("street:highway?seed=303", 60),
    GateKey("street:static?seed=304", 60),
    GateKey("street:crossing?seed=305&sensor=hdl32", 60),
    GateKey("street:highway?seed=306&sensor=hdl32", 60),
    GateKey("street?seed=307&sensor=vlp16", 60),
    GateKey("street?seed=308&sensor=rosette", 60),
)
"""Keys of depth, flow and registration."""

PAIRS = (
    GateKey("argoverse2/sensor/val/7fab2350-7eaf-3b7e-a39d-6937a4c1bede", 0, "car"),
    GateKey("street?seed=311&sensor=dual32", 60),
    GateKey("street:highway?seed=312&sensor=dual32", 60),
)
"""First sweeps of pairs that two scanners measured."""

GROUPS: Mapping[str, frozenset[str]] = {
    "real": frozenset(key.name for key in KEYS if key.is_real),
    "streets": frozenset(key.name for key in KEYS if not key.is_real),
    "pairs": frozenset(key.name for key in PAIRS),
}
"""Names of the keys that are judged together."""


class Stored(NamedTuple):
    """Figures and their luck, each by name of the key."""

    # Name of the key -> name of the figure -> value, see `measure`
    figures: dict[str, dict[str, Any]]
    luck: dict[str, dict[str, float]]  # name of the key -> name of the change -> standard deviation


def read(path: Path) -> Stored:
    """Return stored figures."""
    try:
        return Stored(**json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: {error}; expected a file of densify bench gate --write"
        ) from None


def write(path: Path, stored: Stored) -> None:
    """Write figures and luck as JSON, a figure a line."""
    parts = []
    for part, keys in stored._asdict().items():
        rows = (
            f"  {json.dumps(key)}: {{\n"
            + ",\n".join(f"   {json.dumps(n)}: {json.dumps(v)}" for n, v in figures.items())
            + "\n  }"
            for key, figures in keys.items()
        )
        parts.append(f' "{part}": {{\n' + ",\n".join(rows) + "\n }")
    write_file(path, ("{\n" + ",\n".join(parts) + "\n}\n").encode())


def measure(
    folder: Path | None,
    kinds: Collection[str] = KINDS,
    names: Collection[str] | None = None,
    draws: int = 0,
    progress: Progress | None = None,
    cache: Cache | None = None,
) -> Stored:
    """Return figures and their luck, the standard deviation of each `change` over ``draws``.

    Figures are curves of outliers (`densify.bench.verdicts.Curve`) of the measured and the filled
    map; recall, errors and false positives of the scene flow; errors of poses. Flow between two
    sweeps is estimated in eight draws with moved poses.

    Args:
        folder: Folder of the real recordings; None leaves them out.
        kinds: Some of `KINDS`.
        names: Names of the keys; None for all.
        draws: Number of times that the poses are moved by 2 mm and 0.01°; luck is {} with 0.
        cache: Keeps registration and flow on disk, which pays if only depth changes.
    """
    chosen = _chosen((*KEYS, *PAIRS), folder, names)
    figures: dict[str, dict[str, Any]] = {}
    luck: dict[str, dict[str, float]] = {}
    for number, key in enumerate(chosen):
        sequence = _opened(key, folder)
        if key in PAIRS:
            if "flow" in kinds:
                figures[key.name] = _pair_figures(sequence, key)
        else:
            still = _Still(sequence, key, folder, cache)
            figures[key.name] = still.figures(kinds)
            moved = [still.moved(seed).figures(kinds) for seed in range(draws)]
            luck[key.name] = _luck(figures[key.name], moved)
        if progress is not None:
            progress("gate", number + 1, len(chosen))
    return Stored(figures, luck)


class JudgedMap(NamedTuple):
    """The depth map of a key, its ground truth, and its outliers (H,W), rejected pixels included.

    Returns of another scanner from far inside a moving body are no truth: they passed its windows.
    """

    key: GateKey
    depth: DepthMap
    truth: TruthMap
    # No outlier counts where stereo truth, which widens posts, agrees within 10 px along the row
    outlier: Bool


def judged_maps(
    folder: Path | None, names: Collection[str] | None = None, cache: Cache | None = None
) -> Iterator[JudgedMap]:
    """Yield the depth map of each of `KEYS` with its ground truth; arguments as for `measure`."""
    for key in _chosen(KEYS, folder, names):
        sequence = _opened(key, folder)
        focal_px = sequence.cameras[key.camera].focal_px
        depth, truth = _Still(sequence, key, folder, cache).made(through_glass=False)
        truth = truth._replace(by_disparity=True)
        depth_m = depth.filled_m
        if depth.rejected is not None:
            depth_m = np.maximum(depth_m, depth.rejected.depth_m)
        both = (truth.depth_m > 0) & (depth_m > 0)
        outlier = np.zeros(both.shape, bool)
        outlier[both] = truth.outliers(depth_m, both, focal_px)
        if key.truth == "stereo":
            outlier &= ~agrees_beside(truth, depth_m, _ASIDE_PX, focal_px)
        yield JudgedMap(key, depth, truth, outlier)


def _chosen(
    keys: Iterable[GateKey], folder: Path | None, names: Collection[str] | None
) -> list[GateKey]:
    """Return the keys with these names, None for all; real ones only with a folder."""
    there = [key for key in keys if not key.is_real or folder is not None]
    known = {key.name for key in there}
    for name in set(names or ()) - known:
        raise InputError(f"--keys {name}: no such key; expected of {', '.join(sorted(known))}")
    return [key for key in there if names is None or key.name in names]


def _opened(key: GateKey, folder: Path | None) -> LidarSequence:
    return open_sequence(str(folder / key.data) if key.is_real and folder else key.data)


def _luck(still: Mapping[str, Any], moved: list[dict[str, Any]]) -> dict[str, float]:
    """Return the standard deviation of each change of figures when the poses move."""
    changes = [
        {k: v for name in still for k, v in change(name, still[name], figures[name]).items()}
        for figures in moved
    ]
    if len(changes) < 2:
        return {}
    return {k: round(float(np.std([c[k] for c in changes], ddof=1)), 5) for k in changes[0]}


class _Still:
    """A key with the poses that registration finds."""

    def __init__(
        self, sequence: LidarSequence, key: GateKey, folder: Path | None, cache: Cache | None
    ) -> None:
        self._key, self._whole, self._folder = key, sequence, folder
        self._sequence = Without(sequence, 1) if key.truth == "scanner" else sequence
        self._recording, self._cache = self._recorded(self._sequence, cache), cache
        self._truth = self._true_map() if key.truth != "held out" else None

    def _recorded(self, sequence: Any, cache: Cache | None = None) -> Recording:
        return Recording(
            sequence, resolve(None), _WINDOW, [self._key.key], cache, looks_around=True
        )

    def moved(self, seed: int) -> _Still:
        """Return the key with other poses, and fewer returns for registration."""
        one = object.__new__(_Still)
        one.__dict__ |= self.__dict__
        one._recording = _Moved(self._recording, self._sequence, self._key.key, seed)
        one._sequence = _Thinned(self._sequence, seed)
        return one

    def figures(self, kinds: Collection[str]) -> dict[str, Any]:
        figures: dict[str, Any] = {}
        if "depth" in kinds:
            figures |= self._depth()
        if "flow" in kinds and self._recording.sequence.truth is not None:
            figures |= _flow_figures(self._recording, self._key.key)
        if "registration" in kinds and self._key.truth in ("exact", "scanner"):
            sequence, of_poses = self._sequence, self._recording
            if isinstance(sequence, _Thinned):
                of_poses = self._recorded(sequence)
            figures["poses mm"] = _pose_error_mm(of_poses, self._key.key)
        return figures

    def _true_map(self) -> TruthMap:
        key, config, recording = self._key, resolve(None), self._recording
        shots = key_shots(
            self._whole, choose_cameras(self._whole, [key.camera]), key.key, config.project
        )
        if key.truth == "stereo":
            camera = self._whole.cameras[key.camera]
            return stereo_truth(cast(Path, self._folder) / _STEREO, key.key, camera)
        if key.truth == "scanner":
            return scanner_truth(1, self._whole, key.key, _WINDOW, shots, config, self._cache)[
                key.camera
            ]
        key_sweep = recording.window(key.key)[key.key].sweep
        return exact_truth(self._sequence, key_sweep, shots, config)[key.camera]

    def _depth(self) -> dict[str, Curve]:
        depth, truth = self.made()
        focal_px = self._whole.cameras[self._key.camera].focal_px
        parts = ["all", "moving"] + ["aside"] * (self._key.truth == "stereo")
        return {
            f"{product} {part}": _curve_of(depth, depth_m, truth, part, focal_px)
            for product, depth_m in (("measured", depth.depth_m), ("filled", depth.filled_m))
            for part in parts
            if part != "moving" or truth.moving[truth.depth_m > 0].any()
        }

    def made(self, through_glass: bool = True) -> tuple[DepthMap, TruthMap]:
        """Return the depth map of the key, and its ground truth."""
        # through_glass: keep returns of another scanner from far inside a moving body
        recording, key, camera = self._recording, self._key.key, self._key.camera
        sequence, settings = recording.sequence, recording.settings
        shots = key_shots(sequence, choose_cameras(sequence, [camera]), key, settings.project)
        images, cloud = load_images(sequence, shots), recording.moment(key, True, "").cloud
        beyond = recording.standing(key)
        scene = scene_of(recording, key, shots, images, beyond, cloud, False, Watch())
        seen = see(scene, "flow", cloud)
        if (truth := self._truth) is not None:
            if self._key.truth == "scanner" and not through_glass:
                exposure = scene.views.exposures[camera]
                inside = far_inside(seen.bodies.values(), exposure, truth.depth_m)
                truth = truth._replace(depth_m=np.where(inside, np.float32(0), truth.depth_m))
            return scene.views.depth(seen)[camera], truth
        held_out = HeldOut.of(scene.views, cloud).maps(seen, METHODS["flow"].visible)
        depth, truth_m, moving = held_out[camera]
        return depth, TruthMap(truth_m, moving, by_disparity=True)


class _Moved(Recording):
    """A recording with slightly other poses."""

    def __init__(self, still: Recording, sequence: Any, key: int, seed: int) -> None:
        self._still, self._seed = still, seed
        super().__init__(sequence, still.settings, _WINDOW, [key], looks_around=True)

    def registration(self, number: int) -> Registration:
        registration = self._still.registration(number)
        rng = np.random.default_rng(self._seed)
        pieces = tuple(_jittered(piece, rng) for piece in registration.pieces)
        return Registration(pieces, registration.bad)


def _jittered(trajectory: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return the trajectory with each pose moved by 2 mm and turned by 0.01° along each axis."""
    sigma = np.repeat([np.radians(_TURNED_DEG), _MOVED_M], 3)
    moves = [poses.exp(sigma * rng.standard_normal(6)) for _ in trajectory.frames]
    moved = trajectory.T_world_lidar @ np.stack(moves)
    return Trajectory(trajectory.frames, trajectory.stamp_ns, moved, trajectory.R_level_lidar)


class _Thinned:
    """A recording with a random share of the returns of each sweep."""

    def __init__(self, sequence: Any, seed: int) -> None:
        self._sequence, self._seed = sequence, seed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def __getitem__(self, frame: int) -> Sweep:
        sweep: Sweep = self._sequence[frame]
        rng = np.random.default_rng([self._seed, frame])
        return sweep.select(rng.random(len(sweep)) < _KEPT)


def _curve_of(
    depth: DepthMap, depth_m: Float32, truth: TruthMap, part: str, focal_px: float
) -> Curve:
    """Return the curve of one part of the pixels: all, moving, or all but widened posts (aside)."""
    known = truth.depth_m > 0
    if part == "moving":
        known &= truth.moving
    both = known & (depth_m > 0)
    outliers = truth.outliers(depth_m, both, focal_px)
    if part == "aside":
        outliers &= ~agrees_beside(truth, depth_m, _ASIDE_PX, focal_px)[both]
    return curve(int(known.sum()), depth.confidence[both], outliers)


def _flow_figures(recording: Recording, key: int) -> dict[str, float]:
    """Return recall, false positives, and errors of the moving points of all sweeps of a window."""
    truth, motion = cast(Truth, recording.sequence.truth), recording.motion(key)
    moving, called, one_m, to_key_m = list[Bool](), list[Bool](), list[Float](), list[Float]()
    for registered in recording.window(key).sweeps:
        frame, row = registered.frame, registered.sweep.row
        moves = truth.sweep(frame).moving[row]
        to_key, true_m = motion.flow(frame, key), truth.displacement(frame, key)[row]
        moving.append(moves)
        called.append(to_key.moving)
        if abs(frame - key) == _WINDOW:
            kept = moves & ~to_key.lost
            to_key_m.append(np.linalg.norm(to_key.displacement - true_m, axis=1)[kept])
        if frame < key + _WINDOW:
            step, true_m = motion.flow(frame, frame + 1), truth.displacement(frame, frame + 1)[row]
            one_m.append(np.linalg.norm(step.displacement - true_m, axis=1)[moves])
    moves, calls = np.concatenate(moving), np.concatenate(called)
    figures = {"flow false %": 100 * float(calls[~moves].mean())}
    if moves.any():
        figures |= {
            "flow recall %": 100 * float(calls[moves].mean()),
            "flow error over 1 sweep m": float(np.concatenate(one_m).mean()),
            "flow error over 5 sweeps m": float(np.concatenate(to_key_m).mean()),
        }
    return {name: round(value, 5) for name, value in figures.items()}


def _pose_error_mm(recording: Recording, key: int) -> float:
    """Return the root mean square error of the window's positions relative to the key sweep's."""
    sequence, stretch = recording.sequence, recording.window(key)
    T_true_world = poses.inverse(sequence.T_world_lidar(key))
    off_m = []
    for frame in stretch.frames:
        T_true = T_true_world @ sequence.T_world_lidar(frame)
        T_off = poses.inverse(T_true) @ stretch.T_target_source(key, frame)
        off_m.append(np.linalg.norm(T_off[:3, 3]))
    return round(1000 * float(np.sqrt(np.mean(np.square(off_m)))), 2)


def _pair_figures(sequence: LidarSequence, key: GateKey) -> dict[str, list[float]]:
    """Return figures of the flow from sweep ``key`` to the next, in draws with moved poses."""
    rows = [_pair_row(*pair) for pair in _pairs(sequence, key)]
    return {name: [round(row[name], 5) for row in rows] for name in rows[0]}


def _pairs(sequence: LidarSequence, key: GateKey) -> Iterator[tuple[Any, Float, Bool, Bool]]:
    """Yield flow, true flow (N,3) in metres, and masks (N,) of moving and of static points."""
    config = resolve({"register": {"source": "dataset"}})
    recording, rng = Recording(sequence, config, 1, [key.key]), np.random.default_rng(0)
    source, target = (recording.window(key.key)[key.key + k] for k in (0, 1))
    sweeps = {"source": source.sweep, "target": target.sweep}
    columns: dict[str, Any] = {f"{k}_offset_ns": s.offset_ns for k, s in sweeps.items()}
    columns |= {f"{k}_lidar": s.lidar for k, s in sweeps.items()}
    points = source.sweep.points
    if key.truth == "car":
        near = np.linalg.norm(points - _CAR_M, axis=1) < _CAR_REACH_M
        moving, static = near & (points[:, 2] > 0), np.zeros(len(points), bool)
        true_m: Float = np.broadcast_to(_CAR_FLOW_M, points.shape)
    else:
        truth, row = cast(Truth, sequence.truth), source.sweep.row
        true_m = truth.displacement(key.key, key.key + 1)[row]
        moving = truth.sweep(key.key).moving[row]
        static = ~moving
        moving = moving & (np.linalg.norm(points[:, :2], axis=1) < 35)
    T_source_target = poses.inverse(source.T_world_lidar) @ target.T_world_lidar
    stamps_ns = np.array([source.sweep.stamp_ns, target.sweep.stamp_ns])
    for _ in range(_NUM_DRAWS):
        two = np.stack([np.eye(4), T_source_target])
        moved = _jittered(Trajectory((0, 1), stamps_ns, two), rng).T_world_lidar
        there = poses.transform(poses.inverse(moved[0]) @ moved[1], target.sweep.points)
        yield estimate_flow(points, there, **columns), true_m, moving, static


def _pair_row(flow: Any, true_m: Float, moving: Bool, static: Bool) -> dict[str, float]:
    called = flow.moving & moving
    error_m = np.linalg.norm(flow.displacement - true_m, axis=1)[called]
    row = {
        "pair recall %": 100 * float(flow.moving[moving].mean()),
        "pair error m": float(error_m.mean()) if called.any() else float(np.linalg.norm(true_m[0])),
    }
    return row | ({"pair false %": 100 * float(flow.moving[static].mean())} if static.any() else {})
