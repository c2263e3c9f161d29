# SPDX-License-Identifier: MIT
"""The pairs of clouds that ``densify bench paper`` measures on.

Sets of others are folders of .npz files as FlowNet3D's authors made them (Liu et al., CVPR 2019):
``points1``, ``points2``, ``flow`` and ``valid_mask1`` (FlyingThings3D; camera axes, z forward), or
``pos1``, ``pos2`` and ``gt`` (KITTI without ground; z up). KITTI's own scene flow 2015 (Menze
and Geiger, CVPR 2015) is lifted to points, without the road. Recordings with boxes are labelled as
in `densify.learning.labels`, without the ground and uncertain labels; as in the paper, flow there
includes the motion of the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from densify.config import Config, resolve
from densify.config.errors import InputError
from densify.free_space.ground import ground
from densify.geometry import poses
from densify.geometry.types import Bool, Float, Stretch
from densify.learning.clips import make_clip
from densify.learning.clouds import AboveGround, Sweeps
from densify.learning.labels import Label, label_sweeps
from densify.learning.samples import sample_of
from densify.readers import open_sequence
from densify.readers.decoded_files import read_arrays, read_image
from densify.readers.kitti.drive import Calibration

FARTHEST_M = 35.0
GROUND_M = 1.4
"""Below the camera, which rides 1.65 m above the road."""
_IMAGES = ("disp_occ_0", "disp_occ_1", "flow_occ")
_MOST_SWEEPS = 5
_NAMES = (
    ("points1", "points2", "flow", "valid_mask1"),
    ("pos1", "pos2", "gt", ""),
)
_R_FLU_CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Turns axes right, down, forward into forward, left, up."""


@dataclass(frozen=True)
class PaperPair:
    """Two clouds and the true flow between them.

    source, target: (n,3), (m,3) metres, z up.
    flow: (n,3) metres.
    moving: (n,), None where the set does not tell.
    sweeps: the input of networks.
    T_target_source: (4,4) the vehicle's motion that is part of the flow, where poses are known;
        methods of registered sweeps see clouds without it.
    """

    name: str
    source: Float
    target: Float
    flow: Float
    moving: Bool | None
    sweeps: Sweeps
    T_target_source: Float = field(default_factory=lambda: np.eye(4))

    def of_vehicle(self) -> Float:
        """Return the (n,3) metres by which the vehicle's motion moves the source."""
        moved: Float = poses.transform(self.T_target_source, self.source) - self.source
        return moved


def has_truth(spec: str) -> bool:
    """Return True if a recording has exact truth."""
    return open_sequence(spec).truth is not None


def pair_of_recording(spec: str, key: int) -> PaperPair:
    """Return a sweep and its next one, without ground and the motion of the vehicle.

    Where the recording has no truth, the flow is what this package's engine finds. Raises
    InputError for a key without a next sweep, ComputationError where one cannot be registered.
    """
    sequence = open_sequence(spec)
    labels, settings = "engine", resolve(None)
    if sequence.truth is not None:
        labels, settings = "truth", resolve({"register": {"source": "dataset"}})
    clip = make_clip(sequence, key, settings, labels)
    here = next(i for i, s in enumerate(clip.sweeps) if not s.origin_m.any())
    if here + 1 == len(clip.sweeps):
        raise InputError(f"--data {spec}: no sweep after {key}; choose an earlier one")
    sample = sample_of(clip, here, here + 1, _MOST_SWEEPS, labels)
    if sample.flow is None or sample.moving is None:
        raise ValueError("expected a sample with labels")
    source, target = (clip.sweeps[n].points.astype(np.float64) for n in (here, here + 1))
    flow, moving = sample.flow.double().numpy(), sample.moving.numpy()
    return PaperPair(f"{spec}@{key}", source, target, flow, moving, sample.sweeps)


def pairs_of_boxes(specs: Sequence[str], most: int) -> Iterator[PaperPair]:
    """Yield the sweeps of recordings with tracked boxes, each with its next.

    most: pairs of each recording, 0 for all. Raises InputError for a recording without boxes or one
    that cannot be read, ComputationError where a sweep cannot be registered.
    """
    config = resolve({"register": {"source": "dataset"}})
    for spec in specs:
        sequence = open_sequence(spec)
        labels = label_sweeps(sequence, sequence.frames, config)
        for _, (frame, label) in zip(range(most or len(sequence.frames)), labels, strict=False):
            if not isinstance(label, Label):
                raise label
            yield _pair_of_label(f"{sequence.name}@{frame}", label, config)


def _pair_of_label(name: str, label: Label, config: Config) -> PaperPair:
    stretch = Stretch((label.registered, label.after))
    heights = ground(stretch)
    here, there = (AboveGround.of(s, heights) for s in stretch.sweeps)
    known = label.sure[here.row]
    row, T = here.row[known], label.T_next_here
    source, target = label.registered.sweep.points[row], label.after.sweep.points[there.row]
    if not (len(source) and len(target)):
        raise InputError(f"{name}: no labelled point above the ground")
    placed = AboveGround(row, poses.transform(T, source), here.height_m[known])
    sweeps = tuple(
        s.cloud(T[:3, 3]) for s in (placed, AboveGround(there.row, target, there.height_m))
    )
    flow = poses.transform(T, source + label.field.total[row]) - source
    return PaperPair(name, source, target, flow, label.field.moving[row], sweeps, T)


def pairs_of_kitti(folder: Path, most: int) -> Iterator[PaperPair]:
    """Yield the pairs of KITTI's scene flow 2015, or of .npz files made of it."""
    training = next((p for p in (folder, folder / "training") if (p / _IMAGES[0]).is_dir()), None)
    if training is None:
        yield from pairs_of_files(folder, most, "; nor KITTI's training/disp_occ_0")
        return
    names = sorted(path.stem for path in (training / _IMAGES[0]).glob("*_10.png"))
    if not names:
        raise InputError(f"{training / _IMAGES[0]}: no images such as 000000_10.png")
    for name in names[: most or None]:
        here, there, is_white = read_moments(training, name)
        # Points below that at both moments are the road (Gu et al., "HPLFlowNet", CVPR 2019).
        kept = np.minimum(here[:, 1], there[:, 1]) < GROUND_M
        here, there = (x[kept] @ _R_FLU_CAMERA.T for x in (here, there))
        # No point is in both clouds: pixels alternate, as the squares of a chessboard.
        first = is_white[kept]
        where = f"{training}: {name}"
        yield _pair(name, here[first], there[~first], (there - here)[first], where)


def read_moments(training: Path, name: str) -> tuple[Float, Float, Bool]:
    """Lift the pixels of one pair that have both disparities and flow.

    Returns (n,3) metres of the points at the first and at the second image, in the axes of the left
    camera (x right, y down, z forward), and (n,) whether the pixel is a white square of a
    chessboard. Raises InputError for a file that is missing or of another form.
    """
    first, second, flow = (_image(training / kind / f"{name}.png") for kind in _IMAGES)
    calibration = Calibration.read(training / "calib_cam_to_cam" / f"{name.partition('_')[0]}.txt")
    left, right = (
        calibration.rectified_camera(f"P_rect_{n}", n, (1, 1), np.eye(4)) for n in ("02", "03")
    )
    baseline_m, K = left.T_cam_lidar[0, 3] - right.T_cam_lidar[0, 3], left.K
    if not first.shape == second.shape == flow.shape[:2]:
        raise InputError(f"{training}: {name}: the images of {', '.join(_IMAGES)} differ in size")
    if baseline_m <= 0:
        raise InputError(f"{calibration.path}: P_rect_03 is not to the right of P_rect_02")
    # Images come with blue first: valid, v, u.
    known = (first > 0) & (second > 0) & (flow[..., 0] > 0)
    v, u = np.nonzero(known)
    at_px = np.stack([u, v], axis=1).astype(np.float64)
    moved_px = (flow[known][:, [2, 1]].astype(np.float64) - 2**15) / 64

    def lifted(px: Float, disparity: Float) -> Float:
        depth_m = K[0, 0] * baseline_m * 256 / disparity
        across = (px - K[:2, 2]) / K[[0, 1], [0, 1]]
        return np.column_stack([across * depth_m[:, None], depth_m])

    here = lifted(at_px, first[known].astype(np.float64))
    there = lifted(at_px + moved_px, second[known].astype(np.float64))
    return here, there, (u + v) % 2 == 0


def _image(path: Path) -> np.ndarray:
    image = read_image(path, as_stored=True)
    if image.dtype != np.uint16 or image.ndim != (3 if path.parent.name == _IMAGES[2] else 2):
        raise InputError(
            f"{path}: got {image.dtype} of shape {image.shape}, expected 16 bit as KITTI writes it"
        )
    return image


def pairs_of_files(folder: Path, most: int, beside: str = "") -> Iterator[PaperPair]:
    """Yield the first ``most`` files of a folder, by name; 0 for all. beside: what else was looked
    for. Raises InputError for a folder without any, or a file of another form."""
    paths = sorted(folder.glob("*.npz"))
    if not paths:
        raise InputError(
            f"{folder}: no .npz files; expected the sets of FlowNet3D's authors{beside}"
        )
    for path in paths[: most or None]:
        yield read_pair(path)


def read_pair(path: Path) -> PaperPair:
    """Return the pair of one file, without points farther than 35 m ahead."""
    arrays = read_arrays(path)
    found = next((names for names in _NAMES if all(n in arrays for n in names[:3])), None)
    if found is None:
        raise InputError(
            f"{path}: holds {', '.join(sorted(arrays)) or 'nothing'}, expected points1, points2 "
            f"and flow, or pos1, pos2 and gt"
        )
    source, target, flow = (np.asarray(arrays[name], np.float64) for name in found[:3])
    for name, array in zip(found, (source, target, flow), strict=False):
        if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
            raise InputError(f"{path}: {name}: got shape {array.shape}, expected (N,3) numbers")
    if len(flow) != len(source):
        raise InputError(f"{path}: {found[2]}: got {len(flow)} rows, expected {len(source)}")
    valid = np.ones(len(source), bool)
    if found[3] in arrays:
        valid = np.asarray(arrays[found[3]]).astype(bool).ravel()
        if len(valid) != len(source):
            raise InputError(f"{path}: {found[3]}: got {len(valid)}, expected {len(source)}")
    if found is _NAMES[0]:
        source, target, flow = (x @ _R_FLU_CAMERA.T for x in (source, target, flow))
    return _pair(path.stem, source[valid], target, flow[valid], str(path))


def _pair(name: str, source: Float, target: Float, flow: Float, where: str) -> PaperPair:
    """Return the pair within 35 m ahead (x). Raises InputError, which begins with ``where``, for no
    points there."""
    near = np.abs(source[:, 0]) < FARTHEST_M
    source, flow = source[near], flow[near]
    target = target[np.abs(target[:, 0]) < FARTHEST_M]
    if not (len(source) and len(target)):
        raise InputError(f"{where}: no valid point within {FARTHEST_M:g} m ahead")
    lowest = min(source[:, 2].min(), target[:, 2].min())
    sweeps = []
    for points in (source, target):
        given = AboveGround(
            np.arange(len(points)), points, (points[:, 2] - lowest).astype(np.float32)
        )
        sweeps.append(given.cloud(np.zeros(3)))
    return PaperPair(name, source, target, flow, None, tuple(sweeps))
