# SPDX-License-Identifier: MIT
"""Write scene flow of one window, or of a whole recording in the formats of other programs.

docs/formats/flow-files.md describes them: npz; av2 (the Argoverse 2 scene flow challenge of 2024);
opensceneflow; semantickitti, of semantic-kitti-api (evaluate_mos.py); doc-depth (de Moreau et al.,
"DOC-Depth", IV 2025, FORMAT.md).
"""

from __future__ import annotations

import io
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from densify.config.errors import InputError
from densify.config.file_content import import_extra
from densify.free_space.ground import ABOVE_GROUND_M, ground
from densify.geometry import poses
from densify.geometry.types import Float, FlowField, Int, LidarSequence, Stretch, StretchFlow
from densify.outputs.cloud_files import save_ply
from densify.outputs.folders import file_aside, write_file, write_json
from densify.readers.recorded_poses import PoseTrack

_MOVING, _STATIC = 251, 9  # SemanticKITTI's labels
_GROUND, _STANDING, _DYNAMIC = 0, 50, 100  # DOC-Depth's classes: ground, static, moving

FlowWriter = Callable[[int, StretchFlow], Path]
"""A function that writes the flow of one sweep and returns the folder that holds its file.

The arguments are the sweep's frame number, and its flow to the next sweep. The last sweep has the
flow to the previous sweep instead."""


@contextmanager
def flow_writer(
    form: str, sequence: LidarSequence, out: Path, frames: Sequence[int], overwrite: bool
) -> Iterator[FlowWriter]:
    """Yield a function that writes the flow of one sweep, a `FlowWriter`.

    ``form`` is npz, av2, opensceneflow, semantickitti or doc-depth. ``frames`` are the sweeps to
    write, ascending. Raise InputError if files exist in ``out``, unless ``overwrite`` replaces
    them.
    """
    paths = {frame: _path_of(form, sequence, out, frame) for frame in frames}
    if form == "av2":
        import_extra("pyarrow.feather", "argoverse", "Argoverse 2's flow files")
    present = sorted({path.name for path in paths.values() if path.exists()})
    if present and not overwrite:
        raise InputError(
            f"--out {out}: {present[0]} already there and kept ({len(present)} such files); give "
            f"--overwrite to replace them or another --out DIR"
        )
    T_world_lidar: dict[int, Float] = {}
    file: Any = None
    with ExitStack() as stack:
        if form == "opensceneflow":
            h5py = import_extra("h5py", "opensceneflow", "OpenSceneFlow's files")
            aside = stack.enter_context(file_aside(paths[frames[0]]))
            file = stack.enter_context(h5py.File(aside, "w"))

        def write(frame: int, flow: StretchFlow) -> Path:
            path = paths[frame]
            T_world_lidar[frame] = _chained_pose(T_world_lidar, frame, flow.stretch)
            # These formats have flow forward in time. The last sweep's goes to the previous sweep.
            steps = {step: field for step, field in flow.steps.items() if step[0] < step[1]}
            to_next = StretchFlow(flow.stretch, steps)
            if form == "opensceneflow":
                _add_sweep(file, frame, to_next, T_world_lidar[frame])
            elif form == "av2":
                _write_feather(path, sequence, frame, to_next)
            elif form == "semantickitti":
                _write_labels(path, sequence, frame, flow)
            elif form == "doc-depth":
                _write_classes(path, frame, flow)
            else:
                write_flow_npz(out, to_next, sequence.name)
            return path.parent.parent if form == "doc-depth" else path.parent

        yield write
    if form == "doc-depth" and T_world_lidar:
        _write_paths(paths[frames[0]].parent.parent, sequence, T_world_lidar)


def _path_of(form: str, sequence: LidarSequence, out: Path, frame: int) -> Path:
    """Return the path of the file with a sweep's flow, which as npz the last sweep never has."""
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in sequence.name)
    if form == "av2":
        return out / name / f"{sequence.stamp_ns(frame)}.feather"
    if form == "opensceneflow":
        return out / f"{name}.h5"
    if form == "semantickitti":
        return out / "sequences" / name / "predictions" / f"{frame:06d}.label"
    if form == "doc-depth":
        return out / name / "frames" / f"frame_{frame:06d}.ply"
    following = sequence.frames[bisect_right(sequence.frames, frame) :][:1]
    return _npz_path(out, frame, following[0] if following else frame)


def _npz_path(folder: Path, frame: int, target: int) -> Path:
    return folder / f"{frame:06d}_{target:06d}.npz"


def write_flow_npz(folder: Path, flow: StretchFlow, recording: str) -> None:
    """Write a file for each step between two sweeps, such as ``folder/000119_000120.npz``."""
    for (frame, target), field in flow.steps.items():
        data = flow_npz(
            field,
            row=flow.stretch[frame].sweep.row,
            total_flow=_total_flow(flow, frame, target),
            object=field.instance,
            recording=np.array(recording),
        )
        write_file(_npz_path(folder, frame, target), data)


def flow_npz(field: FlowField, **more_arrays: Any) -> bytes:
    """Return the bytes of a .npz file with a flow field, in float32 metres, and more arrays."""
    arrays: dict[str, Any] = {"residual_flow": field.displacement}
    arrays |= {name: getattr(field, name) for name in ("moving", "instance", "lost")} | more_arrays
    if field.to_reference is not None:
        arrays["to_reference"] = field.to_reference
    for name, array in arrays.items():
        arrays[name] = array.astype(np.float32) if array.dtype == np.float64 else array
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _total_flow(flow: StretchFlow, frame: int, target: int) -> np.ndarray:
    """Return the flow (N,3) in metres, with ego-motion, from sweep ``frame`` to ``target``."""
    # total = T_target_source (p + motion) - p, with the motion in the source's lidar frame
    points, field = flow.stretch[frame].sweep.points, flow.steps[frame, target]
    T = flow.stretch.T_target_source(target, frame)
    return poses.transform(T, points + field.total) - points


def _chained_pose(earlier: dict[int, Float], frame: int, stretch: Stretch) -> Float:
    """Return the (4,4) world pose of a sweep, chained to the latest of the ``earlier`` sweeps."""
    # Each stretch has a world of its own, and shares a sweep with an earlier stretch, or begins.
    previous = next((f for f in reversed(earlier) if f in stretch.frames), None)
    if previous is None:
        return stretch[frame].T_world_lidar
    return earlier[previous] @ stretch.T_target_source(previous, frame)


def _add_sweep(file: Any, frame: int, to_next: StretchFlow, T_world_lidar: Float) -> None:
    """Add a sweep to an open HDF5 file, with the flow to the next sweep if known."""
    sweep, stretch = to_next.stretch[frame].sweep, to_next.stretch
    arrays = {
        "lidar": np.column_stack([sweep.points, 255 * sweep.intensity]).astype(np.float32),
        "pose": T_world_lidar,
        "lidar_id": sweep.lidar,
        "ground_mask": np.zeros(len(sweep), bool),
        "row": sweep.row,
    }
    for (_, target), field in to_next.steps.items():
        arrays |= {
            "flow": _total_flow(to_next, frame, target).astype(np.float32),
            "flow_is_valid": ~field.lost,
            "flow_instance_id": (field.instance + 1).astype(np.int16),
            "ego_motion": stretch.T_target_source(target, frame).astype(np.float32),
        }
    group = file.create_group(str(sweep.stamp_ns))
    for name, array in arrays.items():
        group.create_dataset(name, data=array)


def _num_rows(sequence: LidarSequence, frame: int) -> int:
    """Return the number of rows in the sweep's file, valid or not."""
    return sequence.num_rows(frame) if hasattr(sequence, "num_rows") else len(sequence[frame])


def _write_feather(path: Path, sequence: LidarSequence, frame: int, to_next: StretchFlow) -> None:
    """Write the flow of one sweep. Rows of the sweep file without a valid return have flow 0."""
    arrow, feather = (import_extra(m, "argoverse", "") for m in ("pyarrow", "pyarrow.feather"))
    num_rows = _num_rows(sequence, frame)
    residual = np.zeros((num_rows, 3), np.float16)
    for field in to_next.steps.values():
        residual[to_next.stretch[frame].sweep.row] = field.displacement
    columns = {"is_valid": np.ones(num_rows, bool)}
    columns |= dict(zip(("flow_tx_m", "flow_ty_m", "flow_tz_m"), residual.T.copy(), strict=True))
    with file_aside(path) as aside:
        feather.write_feather(arrow.table(columns), aside)


def _write_labels(path: Path, sequence: LidarSequence, frame: int, flow: StretchFlow) -> None:
    """Write a label for each row of the sweep file. Rows without a usable return are static."""
    labels = np.full(_num_rows(sequence, frame), _STATIC, np.uint32)
    for field in flow.steps.values():
        moving = _MOVING | (field.instance.astype(np.int64) + 1) << 16
        labels[flow.stretch[frame].sweep.row] = np.where(field.moving, moving, _STATIC)
    write_file(path, labels.astype("<u4").tobytes())


def _write_classes(path: Path, frame: int, flow: StretchFlow) -> None:
    """Write the deskewed points of a sweep, each with its DOC-Depth class."""
    registered = flow.stretch[frame]
    points = registered.sweep.points
    points_world = poses.transform(registered.T_world_lidar, points)
    height_m = ground(flow.stretch).above(points_world)
    classes = np.where(height_m < ABOVE_GROUND_M, _GROUND, _STANDING)
    for field in flow.steps.values():
        classes[field.moving] = _DYNAMIC
    columns = dict(zip("xyz", points.T.astype(np.float32), strict=True))
    save_ply(path, columns | {"classid": classes.astype(np.uint16)})


def _write_paths(folder: Path, sequence: LidarSequence, T_world_lidar: dict[int, Float]) -> None:
    """Write the lidar poses, and calibration and poses of the first camera, for DOC-Depth."""
    # traj_camera.ply has the lidar pose at the exposure of each image, and the image's index.
    stamp_ns = np.array([sequence.stamp_ns(f) for f in T_world_lidar], np.int64)
    track = PoseTrack(sequence.name, stamp_ns, np.stack([*T_world_lidar.values()]))
    _save_path(folder / "traj_odometry.ply", track, stamp_ns, list(T_world_lidar))
    for camera in [*sequence.cameras.values()][:1]:
        exposed_ns = np.array([*sequence.image_stamps_ns(camera.name).values()], np.int64)
        inside = np.flatnonzero((exposed_ns >= stamp_ns[0]) & (exposed_ns <= stamp_ns[-1]))
        _save_path(folder / "traj_camera.ply", track, exposed_ns[inside], inside.tolist())
        write_json(folder / "calib.json", {"mtx": camera.K.tolist()})
        rows = "".join(" ".join(map(repr, row)) + "\n" for row in camera.T_cam_lidar.tolist())
        write_file(folder / "calib_lidar_ref_cam.txt", rows.encode())


def _save_path(path: Path, track: PoseTrack, stamps_ns: Int, numbers: Sequence[int]) -> None:
    """Write the poses of a track at (n,) times, each with its number, as PLY."""
    T = np.array([track.at(int(ns)) for ns in stamps_ns]).reshape(-1, 4, 4)
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat().T if len(T) else np.zeros((4, 0))
    columns = dict(zip("xyz", T[:, :3, 3].T, strict=True))
    for names in (("qx", "qy", "qz", "qw"), ("q_x", "q_y", "q_z", "q_w")):
        columns |= dict(zip(names, quaternions, strict=True))
    columns |= {"timestamp": stamps_ns * 1e-9, "indices": np.array(numbers, np.int32)}
    save_ply(path, columns)
