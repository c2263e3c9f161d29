# SPDX-License-Identifier: MIT
"""Measure the main figures of many keys: ``densify bench gate``, ``densify bench baselines``."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import cv2
import numpy as np

from densify.bench.depth import (
    Altered,
    TruthMap,
    agrees_beside,
    exact_truth,
    scanner_truth,
    stereo_truth,
    without_scanner,
)
from densify.bench.verdicts import Curve, change, curve
from densify.config import resolve
from densify.config.cache import Cache
from densify.config.errors import InputError
from densify.depth.exposure import key_shots, load_images
from densify.depth.moving_bodies import find_far_inside
from densify.depth.views import HeldOut
from densify.flow.two_clouds import estimate_flow
from densify.geometry import poses
from densify.geometry.types import (
    Bool,
    Camera,
    DepthMap,
    Float,
    Float32,
    LidarSequence,
    Progress,
    Sweep,
    Trajectory,
    Truth,
)
from densify.outputs.folders import write_file
from densify.pipeline.key_result import METHODS, see
from densify.pipeline.process import Watch
from densify.pipeline.recording import Recording
from densify.pipeline.run import densify, scene_of
from densify.readers import open_sequence
from densify.readers.timeline import choose_cameras
from densify.registration.trajectory import Registration
from densify.scores.metrics import (
    DepthErrors,
    end_point_errors,
    errors_by_part,
    mean_errors,
    window_pose_errors,
)

KINDS = ("depth", "flow", "registration")
_WINDOW = 5
_NUM_DRAWS = 8  # random draws of each pair
_MOVED_M, _TURNED_DEG = 0.002, 0.01  # standard deviations of a moved pose, for luck
_KEPT = 0.98  # share of the returns that are kept, for the luck of registration
_ASIDE_PX = 10  # by which the truth of the stereo benchmark widens posts and signs
_STEREO = "kitti_stereo/truth"
_DRIVE = "2011_09_26/2011_09_26_drive_0013_sync"
_CAR_M, _CAR_REACH_M = (-4.6, -2.2, 0.0), 2.5  # the nearest moving car of the Argoverse 2 pair
_CAR_FLOW_M = (0.83, 0.0, 0.0)  # by its profile, which both sweeps measured
_PAIR_REACH_M = 35.0  # of the scored moving points


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
    """Return the figures of a file that `write` wrote, and their luck; InputError for others."""
    try:
        return Stored(**json.loads(path.read_text("utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise InputError(
            f"{path}: {error}; expected a file of densify bench gate --write"
        ) from None


def write(path: Path, stored: Stored) -> None:
    """Write figures and luck as JSON, with one line for each figure."""
    write_file(path, (_as_lines(stored._asdict()) + "\n").encode())


def _as_lines(value: Any, depth: int = 0) -> str:
    """Return JSON in which tables three deep (kind, key, figure) have a line for each row."""
    if depth == 3:
        return json.dumps(value)
    indent = " " * depth
    rows = (f"{indent} {json.dumps(k)}: {_as_lines(v, depth + 1)}" for k, v in value.items())
    return "{\n" + ",\n".join(rows) + f"\n{indent}}}"


def measure(
    folder: Path | None,
    kinds: Collection[str] = KINDS,
    names: Collection[str] | None = None,
    draws: int = 0,
    progress: Progress | None = None,
    cache: Cache | None = None,
) -> Stored:
    """Measure the figures of many keys, and return them with their luck.

    Luck is the standard deviation of each `change` over draws with moved poses. Figures are curves
    of outliers (`densify.bench.verdicts.Curve`) of the measured and the filled map; recall, errors
    and false positives of the scene flow; errors of poses. Flow between two sweeps is estimated in
    eight draws with moved poses.

    Args:
        folder: Folder of the real recordings; None leaves them out.
        kinds: Some of `KINDS`.
        names: Names of the keys; None for all.
        draws: Number of times that the poses are moved by 2 mm and 0.01°; luck is {} with 0 or 1.
        progress: Callback (stage, done, total).
        cache: Keeps registration and flow on disk, which pays if only depth changes.
    """
    chosen = _choose_keys((*KEYS, *PAIRS), folder, names)
    figures: dict[str, dict[str, Any]] = {}
    luck: dict[str, dict[str, float]] = {}
    for number, key in enumerate(chosen):
        if key not in PAIRS:
            subject = Subject.of(key, folder, cache)
            figures[key.name] = subject.figures(kinds)
            draws_moved = [subject.figures(kinds, seed) for seed in range(draws)]
            luck[key.name] = _find_luck(figures[key.name], draws_moved)
        elif "flow" in kinds:
            figures[key.name] = _pair_figures(key, folder)
        if progress is not None:
            progress("gate", number + 1, len(chosen))
    return Stored(figures, luck)


class JudgedMap(NamedTuple):
    """The depth map of a key, its ground truth, and its outliers (H,W), rejected pixels too."""

    key: GateKey
    depth: DepthMap
    truth: TruthMap
    # No outlier counts where stereo truth, which widens posts, agrees within 10 px along the row
    outlier: Bool


def judged_maps(
    folder: Path | None, names: Collection[str] | None = None, cache: Cache | None = None
) -> Iterator[JudgedMap]:
    """Yield the map, truth and outliers of each of `KEYS`.

    ``folder`` has the real recordings, None leaves these out. ``names`` None takes all keys.
    """
    for key in _choose_keys(KEYS, folder, names):
        subject = Subject.of(key, folder, cache)
        focal_px = subject.camera.focal_px
        depth, truth = subject.depth_and_truth(subject.recording, through_glass=False)
        truth = truth._replace(by_disparity=True)
        depth_m = depth.filled_m
        if depth.rejected is not None:
            depth_m = np.maximum(depth_m, depth.rejected.depth_m)
        outlier = truth.outliers(depth_m, focal_px)
        if key.truth == "stereo":
            outlier &= ~agrees_beside(truth, depth_m, _ASIDE_PX, focal_px)
        yield JudgedMap(key, depth, truth, outlier)


def _choose_keys(
    keys: Iterable[GateKey], folder: Path | None, names: Collection[str] | None
) -> list[GateKey]:
    """Return the keys with these names, None for all; real ones only with a folder."""
    known = {key.name: key for key in keys if not key.is_real or folder is not None}
    for name in names or ():
        if name not in known:
            expected = ", ".join(sorted(known))
            raise InputError(f"--keys {name}: no such key; expected of {expected}")
    return [key for name, key in known.items() if names is None or name in names]


def _open(key: GateKey, folder: Path | None) -> LidarSequence:
    """Open the recording of a key, a real one in the folder of recordings."""
    return open_sequence(str(folder / key.data) if key.is_real and folder else key.data)


def _find_luck(figures: Mapping[str, Any], draws_moved: list[dict[str, Any]]) -> dict[str, float]:
    """Return the standard deviation of each change of the figures when the poses move."""
    if len(draws_moved) < 2:
        return {}
    changes: dict[str, list[float]] = defaultdict(list)
    for figures_moved in draws_moved:
        for figure, value in figures.items():
            for name, difference in change(figure, value, figures_moved[figure]).items():
                changes[name].append(difference)
    return {name: round(float(np.std(values, ddof=1)), 5) for name, values in changes.items()}


class Subject(NamedTuple):
    """A key with the recording that is densified and the truth that its maps are compared with."""

    key: GateKey
    whole: LidarSequence  # recording with the returns that are the truth
    recording: Recording  # recording without them, with the poses that registration finds
    truth: TruthMap | None  # None where returns of the key sweep are held out instead

    @staticmethod
    def of(key: GateKey, folder: Path | None, cache: Cache | None) -> Subject:
        """Open the recording of a key, below ``folder`` if real, and find its true depth."""
        whole, config = _open(key, folder), resolve(None)
        sequence = without_scanner(whole, 1) if key.truth == "scanner" else whole
        recording = Recording(sequence, config, _WINDOW, [key.key], cache, looks_around=True)
        truth, cameras = None, choose_cameras(whole, [key.camera])
        shots = key_shots(whole, cameras, key.key, config.project)
        if key.truth == "stereo":
            truth = stereo_truth(cast(Path, folder) / _STEREO, key.key, cameras[0])
        elif key.truth == "scanner":
            measured = Recording(whole, config, _WINDOW, [key.key], cache, looks_around=True)
            truth = scanner_truth(1, measured, key.key, shots)[key.camera]
        elif key.truth == "exact":
            key_sweep = recording.window(key.key)[key.key].sweep
            truth = exact_truth(sequence, key_sweep, shots, config)[key.camera]
        return Subject(key, whole, recording, truth)

    @property
    def camera(self) -> Camera:
        """The camera of the depth map."""
        return self.whole.cameras[self.key.camera]

    def figures(self, kinds: Collection[str], seed: int | None = None) -> dict[str, Any]:
        """Return name of the figure -> value, of some of `KINDS`.

        A ``seed`` moves the poses of depth and flow, and thins the sweeps that are registered.
        """
        key, recording, registered = self.key.key, self.recording, self.recording
        if seed is not None:
            recording = _MovedRecording(self.recording, key, seed)
            sequence: Any = Altered(recording.sequence, lambda sweep: _thin(sweep, seed))
            registered = Recording(sequence, recording.settings, _WINDOW, [key], looks_around=True)
        figures: dict[str, Any] = {}
        if "depth" in kinds:
            figures |= self._curves(recording)
        if "flow" in kinds and recording.sequence.truth is not None:
            figures |= _flow_figures(recording, key)
        if "registration" in kinds and self.key.truth in ("exact", "scanner"):
            true_pose = registered.sequence.T_world_lidar
            error_m, _ = window_pose_errors(registered.window(key), key, true_pose)
            figures["poses mm"] = round(1000 * error_m, 2)
        return figures

    def _curves(self, recording: Recording) -> dict[str, Curve]:
        """Return the curves of the measured and the filled map, for each group of pixels."""
        depth, truth = self.depth_and_truth(recording)
        known, focal_px, curves = truth.depth_m > 0, self.camera.focal_px, {}
        groups = {"all": known}
        if truth.moving[known].any():
            groups["moving"] = known & truth.moving
        if self.key.truth == "stereo":
            groups["aside"] = known  # without outliers at widened posts
        for product, depth_m in (("measured", depth.depth_m), ("filled", depth.filled_m)):
            outliers = truth.outliers(depth_m, focal_px)
            for group, pixels in groups.items():
                if group == "aside":  # the last group
                    outliers &= ~agrees_beside(truth, depth_m, _ASIDE_PX, focal_px)
                compared = pixels & (depth_m > 0)
                judged = depth.confidence[compared], outliers[compared]
                curves[f"{product} {group}"] = curve(int(pixels.sum()), *judged)
        return curves

    def depth_and_truth(
        self, recording: Recording, through_glass: bool = True
    ) -> tuple[DepthMap, TruthMap]:
        """Return the depth map of the key, and its truth.

        ``through_glass`` False drops a scanner's returns from inside moving vehicles.
        """
        key, camera, truth = self.key.key, self.key.camera, self.truth
        sequence, settings = recording.sequence, recording.settings
        shots = key_shots(sequence, choose_cameras(sequence, [camera]), key, settings.project)
        images, cloud = load_images(sequence, shots), recording.moment(key, True, "").cloud
        far = recording.find_far_surfaces(key)
        scene = scene_of(recording, key, shots, images, far, cloud, False, Watch())
        seen = see(scene, "flow", cloud)
        if truth is None:
            held_out = HeldOut.of(scene.views, cloud).judged_maps(seen, METHODS["flow"].visible)
            depth, truth_m, moving = held_out[camera]
            return depth, TruthMap(truth_m, moving, by_disparity=True)
        if self.key.truth == "scanner" and not through_glass:
            exposure = scene.views.exposures[camera]
            inside = find_far_inside(seen.bodies.values(), exposure, truth.depth_m)
            truth = truth._replace(depth_m=np.where(inside, np.float32(0), truth.depth_m))
        return scene.views.depth_maps(seen)[camera], truth


class _MovedRecording(Recording):
    """A recording whose registered poses are moved slightly and at random."""

    def __init__(self, still: Recording, key: int, seed: int) -> None:
        self._registered, self._seed = still, seed
        super().__init__(still.sequence, still.settings, _WINDOW, [key], looks_around=True)

    def registration(self, number: int) -> Registration:
        registration = self._registered.registration(number)
        rng = np.random.default_rng(self._seed)
        pieces = tuple(_jitter(piece, rng) for piece in registration.pieces)
        return Registration(pieces, registration.left_out)


def _jitter(trajectory: Trajectory, rng: np.random.Generator) -> Trajectory:
    """Return the trajectory with each pose moved by 2 mm and turned by 0.01° along each axis."""
    sigma = np.repeat([np.radians(_TURNED_DEG), _MOVED_M], 3)
    moves = poses.exp(sigma * rng.standard_normal((len(trajectory.frames), 6)))
    return replace(trajectory, T_world_lidar=trajectory.T_world_lidar @ moves)


def _thin(sweep: Sweep, seed: int) -> Sweep:
    """Return the sweep with a random 98 % of its returns."""
    rng = np.random.default_rng([seed, sweep.frame])
    return sweep.select(rng.random(len(sweep)) < _KEPT)


def _flow_figures(recording: Recording, key: int) -> dict[str, float]:
    """Return recall, false positives, and errors of the moving points of all sweeps of a window."""
    truth, motion = cast(Truth, recording.sequence.truth), recording.motion(key)
    columns: defaultdict[str, list[Any]] = defaultdict(list)
    for registered in recording.window(key).sweeps:
        frame, row = registered.frame, registered.sweep.row
        moves, to_key = truth.sweep(frame).moving[row], motion.flow(frame, key)
        columns["moves"].append(moves)
        columns["called"].append(to_key.moving)
        if abs(frame - key) == _WINDOW:
            true_m = truth.displacement(frame, key)[row]
            error_m = end_point_errors(to_key.displacement, true_m)
            columns["error over 5 m"].append(error_m[moves & ~to_key.lost])
        if frame < key + _WINDOW:
            true_m = truth.displacement(frame, frame + 1)[row]
            error_m = end_point_errors(motion.flow(frame, frame + 1).displacement, true_m)
            columns["error over 1 m"].append(error_m[moves])
    pooled = {name: np.concatenate(of_sweeps) for name, of_sweeps in columns.items()}
    moves, called = pooled["moves"], pooled["called"]
    figures = {"flow false %": 100 * float(called[~moves].mean())}
    if moves.any():
        figures |= {
            "flow recall %": 100 * float(called[moves].mean()),
            "flow error over 1 sweep m": float(pooled["error over 1 m"].mean()),
            "flow error over 5 sweeps m": float(pooled["error over 5 m"].mean()),
        }
    return {name: round(value, 5) for name, value in figures.items()}


def _pair_figures(key: GateKey, folder: Path | None) -> dict[str, list[float]]:
    """Return figures of the flow from sweep ``key`` to the next, in draws with moved poses."""
    sequence, config = _open(key, folder), resolve({"register": {"source": "dataset"}})
    window = Recording(sequence, config, 1, [key.key]).window(key.key)
    frames = key.key, key.key + 1
    first, second = (window[frame].sweep for frame in frames)
    stamps_ns = np.array([first.stamp_ns, second.stamp_ns])
    T_first_second = window.T_target_source(*frames)
    recorded = Trajectory((0, 1), stamps_ns, np.stack([np.eye(4), T_first_second]))
    true_m, moving, static = _pair_truth(key, sequence.truth, first)
    rng = np.random.default_rng(0)
    figures: dict[str, list[float]] = defaultdict(list)
    for _ in range(_NUM_DRAWS):
        T_world_first, T_world_second = _jitter(recorded, rng).T_world_lidar
        flow = estimate_flow(
            first.points,
            poses.transform(poses.inverse(T_world_first) @ T_world_second, second.points),
            source_offset_ns=first.offset_ns,
            target_offset_ns=second.offset_ns,
            source_lidar=first.lidar,
            target_lidar=second.lidar,
        )
        error_m = end_point_errors(flow.displacement, true_m)[flow.moving & moving]
        error_of_zero_m = float(np.linalg.norm(true_m[0]))
        figures["pair recall %"].append(100 * float(flow.moving[moving].mean()))
        figures["pair error m"].append(float(error_m.mean()) if len(error_m) else error_of_zero_m)
        if static.any():
            figures["pair false %"].append(100 * float(flow.moving[static].mean()))
    return {name: [round(value, 5) for value in values] for name, values in figures.items()}


def _pair_truth(key: GateKey, truth: Truth | None, first: Sweep) -> tuple[Float, Bool, Bool]:
    """Return true flow (N,3) in metres of a pair's first sweep, and masks (N,): moving, static."""
    # The masks select the scored points. Without known static points the second one is empty.
    points = first.points
    if truth is None:  # the pair of Argoverse 2
        is_near = np.linalg.norm(points - _CAR_M, axis=1) < _CAR_REACH_M
        true_m: Float = np.broadcast_to(_CAR_FLOW_M, points.shape)
        return true_m, is_near & (points[:, 2] > 0), np.zeros(len(points), bool)
    true_m = truth.displacement(key.key, key.key + 1)[first.row]
    static = ~truth.sweep(key.key).moving[first.row]
    moving = ~static & (np.linalg.norm(points[:, :2], axis=1) < _PAIR_REACH_M)
    return true_m, moving, static


_FARTHEST_M = 100.0  # depth that is inverted to 0; farther returns are not used
_DIAMOND = np.array(
    [[0, 0, 1, 0, 0], [0, 1, 1, 1, 0], [1, 1, 1, 1, 1], [0, 1, 1, 1, 0], [0, 0, 1, 0, 0]], np.uint8
)
_SINGLE_SWEEP = {"accumulate": {"far_m": 0}}

KEYS_OF_TRUTH: Mapping[str, tuple[GateKey, ...]] = {
    "KITTI, stereo": tuple(key for key in KEYS if key.truth == "stereo"),
    "PandaSet, second scanner": tuple(key for key in KEYS if key.truth == "scanner"),
    "street, exact": tuple(key for key in KEYS if key.data == "street?seed=301"),
}
"""Name of a truth -> keys that it scores."""


def errors_of_methods(
    keys: Sequence[GateKey], folder: Path | None
) -> dict[str, dict[str, DepthErrors]]:
    """Return method -> part of the pixels (as `errors_by_part`) -> mean errors over the keys."""
    errors: dict[str, dict[str, list[DepthErrors]]] = {}
    for key in keys:
        subject = Subject.of(key, folder, None)
        truth = cast(TruthMap, subject.truth)  # none of these keys is held out
        focal_px = subject.camera.focal_px
        for method, depth_m in _maps(subject).items():
            parts = errors_by_part(
                depth_m, truth.depth_m, truth.moving, focal_px=focal_px, baseline_m=truth.baseline_m
            )
            for part, of_key in parts.items():
                errors.setdefault(method, {}).setdefault(part, []).append(of_key)
    return {
        method: {part: mean_errors(of_keys) for part, of_keys in parts.items()}
        for method, parts in errors.items()
    }


def _maps(subject: Subject) -> dict[str, Float32]:
    """Return name of the method -> depth map (H,W) in metres, 0 for no depth."""
    key, camera = subject.key.key, subject.key.camera
    methods = ("none", "icp", "icp-visible", "flow")
    results = densify(subject.recording, key, methods, [camera], Watch())
    sweep_m, ours = results["none"].depth[camera].depth_m, results["flow"].depth[camera]
    alone = Recording(subject.recording.sequence, resolve(_SINGLE_SWEEP), 0, [key])
    single = densify(alone, key, ["flow"], [camera], Watch())["flow"].depth[camera]
    return {
        "single sweep": sweep_m,
        "single sweep, filled": single.filled_m,
        "single sweep, IP-Basic": ip_basic(sweep_m),
        "rigid (ICP)": results["icp"].depth[camera].depth_m,
        "rigid, cleaned": results["icp-visible"].depth[camera].depth_m,
        "densify, measured": ours.depth_m,
        "densify, filled": ours.filled_m,
    }


def ip_basic(sparse_m: Float32) -> Float32:
    """Return the (H,W) depth map, metres, that dilation and closing fill from a sparse map.

    Pixels without a depth nearby stay 0. ``sparse_m`` is (H,W) metres, 0 for none. Source: Ku,
    Harakeh, Waslander, "In Defense of Classical Image Processing: Fast Depth Completion on the
    CPU", CRV 2018. Unlike there, columns are not extended upwards to the top of the image.
    """
    # Inverted, the nearest depth of a neighbourhood is the largest, which dilation takes.
    has_depth = (sparse_m > 0) & (sparse_m < _FARTHEST_M)
    inverted = np.where(has_depth, np.float32(_FARTHEST_M) - sparse_m, np.float32(0))
    inverted = np.asarray(cv2.dilate(inverted, _DIAMOND), np.float32)
    inverted = cv2.morphologyEx(inverted, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    for size in (7, 31):
        dilated = cv2.dilate(inverted, np.ones((size, size), np.uint8))
        inverted = np.where(inverted > 0, inverted, dilated).astype(np.float32)
    blurred = cv2.GaussianBlur(cv2.medianBlur(inverted, 5), (5, 5), 0)
    return np.where(inverted > 0, np.float32(_FARTHEST_M) - blurred, 0).astype(np.float32)
