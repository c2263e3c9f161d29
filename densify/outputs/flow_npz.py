# SPDX-License-Identifier: MIT
"""Flow files as `densify.readers.flow_files` describes and reads them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np

from densify.geometry import poses
from densify.geometry.types import FlowField, Result, StretchFlow
from densify.outputs.atomic import write_file
from densify.outputs.context import Context
from densify.outputs.flow_h5 import write_flow_h5


def write_output(result: Result, context: Context, folder: Path) -> None:
    """``flow/``, where it is asked for, in the form of ``output.flow_as``."""
    if result.flow is None:
        return
    if context.config["output"]["flow_as"] == "opensceneflow":
        write_flow_h5(folder / "flow", result.key, result.flow)
    else:
        write_flow_files(folder / "flow", result.flow)


def write_flow_files(folder: Path, flow: StretchFlow) -> None:
    """``folder/000119_000120.npz`` and so on, one for each step."""
    folder.mkdir(exist_ok=True)
    for (frame, target), field in flow.steps.items():
        sweep = flow.stretch[frame].sweep
        arrived = sweep.points + field.total
        in_target = poses.transform(flow.stretch.T_target_source(target, frame), arrived)
        total_flow = in_target - sweep.points
        data = flow_npz(field, row=sweep.row, total_flow=total_flow, object=field.instance)
        write_file(folder / f"{frame:06d}_{target:06d}.npz", data)


def flow_npz(field: FlowField, **beside: Any) -> bytes:
    """``residual_flow`` float32, ``moving``, ``instance`` (-1 none), ``lost``, ``to_reference``
    float32 where known, and what is given beside."""
    if field.to_reference is not None:
        beside["to_reference"] = field.to_reference
    arrays = {
        "residual_flow": field.displacement,
        "moving": field.moving,
        "instance": field.instance,
        "lost": field.lost,
        **beside,
    }
    for name, array in arrays.items():
        if array.dtype == np.float64:
            arrays[name] = array.astype(np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()
