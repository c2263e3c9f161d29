# SPDX-License-Identifier: MIT
"""Write scene flow of a key, and of a whole recording in the forms of other programs.

NAME is that of the recording::

    npz            OUT/000119_000120.npz: flow files, see `densify.readers.flow_files`
    av2            OUT/NAME/STAMP.feather, of the Argoverse 2 scene flow challenge of 2024: is_valid
                   bool, flow_tx_m flow_ty_m flow_tz_m float16, to the next sweep without the
                   ego-motion; a row for each of the sweep's file, in its frame
    opensceneflow  OUT/NAME.h5 (https://github.com/KTH-RPL/OpenSceneFlow), a group for each sweep,
                   its stamp in ns: lidar (N,4) deskewed to the stamp, pose (4,4), lidar_id,
                   ground_mask (all False), row (N,) in the sweep's file; with the ego-motion, where
                   known: flow (N,3), flow_is_valid, flow_instance_id (0 none), ego_motion (4,4)

The challenge takes every fifth sweep, zipped as NAME/0000000000.feather, NAME/0000000005.feather….
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from densify.config.errors import InputError
from densify.config.file_content import needed
from densify.geometry import poses
from densify.geometry.types import FlowField, LidarSequence, Result, StretchFlow
from densify.outputs.atomic import file_aside, write_file
from densify.outputs.key_outputs import Context

FlowWriter = Callable[[int, StretchFlow], Path]
"""Writes a sweep and its flow to the next, the only step it is given (none: the last sweep), and
returns the folder of its file."""


def write_flow(result: Result, context: Context, folder: Path) -> None:
    """Write ``flow/`` if ``output.flow`` asks for it."""
    if result.flow is not None:
        write_flow_npz(folder / "flow", result.flow)


def write_flow_npz(folder: Path, flow: StretchFlow) -> list[Path]:
    """Write ``folder/000119_000120.npz`` and so on, one for each step, and return the paths."""
    paths = []
    for (frame, target), field in flow.steps.items():
        sweep = flow.stretch[frame].sweep
        total_flow = _total_flow(flow, frame, target)
        data = flow_npz(field, row=sweep.row, total_flow=total_flow, object=field.instance)
        paths.append(folder / f"{frame:06d}_{target:06d}.npz")
        write_file(paths[-1], data)
    return paths


def _total_flow(flow: StretchFlow, frame: int, target: int) -> np.ndarray:
    """Return (N,3) metres from each point to its position at the target's time, with ego-motion.

    The position is in the frame of the target.
    """
    points, field = flow.stretch[frame].sweep.points, flow.steps[frame, target]
    T = flow.stretch.T_target_source(target, frame)
    return poses.transform(T, points + field.total) - points


def flow_npz(field: FlowField, **beside: Any) -> bytes:
    """Return a file of a flow field.

    It has ``residual_flow`` float32, ``moving``, ``instance`` (-1 none), ``lost``, ``to_reference``
    float32 if it is known, and the arrays in ``beside``.
    """
    arrays: dict[str, Any] = {"residual_flow": field.displacement}
    arrays |= {name: getattr(field, name) for name in ("moving", "instance", "lost")} | beside
    if field.to_reference is not None:
        arrays["to_reference"] = field.to_reference
    for name, array in arrays.items():
        arrays[name] = array.astype(np.float32) if array.dtype == np.float64 else array
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _add_sweep(file: Any, frame: int, flow: StretchFlow) -> None:
    """Add a sweep to an open file, with its flow to the next one if known."""
    registered = flow.stretch[frame]
    sweep = registered.sweep
    arrays = {
        "lidar": np.column_stack([sweep.points, 255 * sweep.intensity]).astype(np.float32),
        "pose": registered.T_world_lidar,
        "lidar_id": sweep.lidar,
        "ground_mask": np.zeros(len(sweep), bool),
        "row": sweep.row,
    }
    for (here, following), field in flow.steps.items():
        if here == frame < following:
            arrays |= {
                "flow": _total_flow(flow, frame, following).astype(np.float32),
                "flow_is_valid": ~field.lost,
                "flow_instance_id": (field.instance + 1).astype(np.int16),
                "ego_motion": flow.stretch.T_target_source(following, frame).astype("f4"),
            }
    group = file.create_group(str(sweep.stamp_ns))
    for name, array in arrays.items():
        group.create_dataset(name, data=array)


@contextmanager
def flow_writer(
    form: str, sequence: LidarSequence, out: Path, frames: Sequence[int], overwrite: bool
) -> Iterator[FlowWriter]:
    """Yield a writer for these sweeps. Each file appears when it is complete.

    Args:
        form: npz, av2 or opensceneflow, whose file has all sweeps.

    Raises:
        InputError: A package is missing, or a file exists and must not be overwritten.
        OutputError: Nothing can be written.
    """
    name = "".join(c if c.isalnum() or c in "-_." else "_" for c in sequence.name)
    following = dict(zip(sequence.frames[:-1], sequence.frames[1:], strict=True))
    if form == "av2":
        paths = {f: out / name / f"{sequence.stamp_ns(f)}.feather" for f in frames}
        needed("pyarrow.feather", "argoverse", "Argoverse 2's flow files")
    elif form == "opensceneflow":
        paths = dict.fromkeys(frames, out / f"{name}.h5")
    else:
        paths = {f: out / f"{f:06d}_{following[f]:06d}.npz" for f in frames if f in following}
    there = sorted({path.name for path in paths.values() if path.exists()})
    if there and not overwrite:
        raise InputError(
            f"--out {out}: {there[0]} already there and kept ({len(there)} such files); give "
            f"--overwrite to replace them or another --out DIR"
        )
    with ExitStack() as stack:
        if form == "opensceneflow":
            h5py = needed("h5py", "opensceneflow", "OpenSceneFlow's files")
            aside = stack.enter_context(file_aside(out / f"{name}.h5"))
            file = stack.enter_context(h5py.File(aside, "w"))

        def write(frame: int, flow: StretchFlow) -> Path:
            if form == "opensceneflow":
                _add_sweep(file, frame, flow)
            elif form == "av2":
                _write_feather(paths[frame], sequence, frame, flow)
            else:
                write_flow_npz(out, flow)
            return out / name if form == "av2" else out

        yield write


def _write_feather(path: Path, sequence: LidarSequence, frame: int, flow: StretchFlow) -> None:
    """Write the flow of one sweep. Rows without a valid return are static."""
    arrow, feather = (needed(m, "argoverse", "") for m in ("pyarrow", "pyarrow.feather"))
    num_rows = sequence.num_rows(frame) if hasattr(sequence, "num_rows") else len(sequence[frame])
    residual = np.zeros((num_rows, 3), np.float16)
    for field in flow.steps.values():
        residual[flow.stretch[frame].sweep.row] = field.displacement
    columns = {"is_valid": np.ones(num_rows, bool)}
    columns |= dict(zip(("flow_tx_m", "flow_ty_m", "flow_tz_m"), residual.T.copy(), strict=True))
    with file_aside(path) as aside:
        feather.write_feather(arrow.table(columns), aside)
