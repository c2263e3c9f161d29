# SPDX-License-Identifier: MIT
"""``densify flow``: scene flow between two point files, or of a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import densify
from densify.cli.answer import Answer
from densify.cli.options import (
    DATA_HELP,
    add_config_options,
    add_overwrite,
    add_verb,
    key_slice,
    sliced,
)
from densify.cli.progress import progress_on_stderr
from densify.config import Config, resolve
from densify.config.errors import ComputationError, InputError


def add(commands: Any) -> None:
    """Its options."""
    about = "scene flow of a recording, or between two point files in one coordinate frame"
    parser = add_verb(
        commands,
        "flow",
        answer,
        about,
        "Point files: .npy (N,3 or more columns), .npz (array 'points'), .txt and .csv (columns), "
        ".bin (float32 columns, as KITTI's), .pcd, .ply, .las, .laz. Where both are .npz and "
        "hold when each point was measured ('offset_ns', or 'time' in seconds) or by which "
        "scanner ('lidar'), that is used. "
        "The result holds 'residual_flow' (N,3) float32 metres, "
        "'moving' (N,) bool, 'instance' (N,) int32 (-1 none) and 'lost' (N,) bool, row by row as "
        "SOURCE. Of a recording, the flow of each sweep to the next is written: npz: "
        "DIR/FRAME_NEXT.npz, flow files as --flow npz:DIR reads them; av2: DIR/NAME/STAMP.feather, "
        "the files of the Argoverse 2 scene flow challenge (all points, without the ego-motion); "
        "opensceneflow: DIR/NAME.h5, all sweeps with their flow.",
    )
    for name, when in (("source", "first"), ("target", "second")):
        parser.add_argument(
            name, metavar=name.upper(), type=Path, nargs="?", help=f"points at the {when} time"
        )
    parser.add_argument("--data", metavar="SPEC", help=f"instead: {DATA_HELP.partition(' (')[0]}")
    parser.add_argument("--all", action="store_true", help="every sweep of it")
    parser.add_argument(
        "--keys", type=key_slice, metavar="A:B[:S]", help="sweeps A to B-1, every S-th"
    )
    parser.add_argument(
        "--format",
        choices=("npz", "av2", "opensceneflow"),
        help="of what is written (default: npz)",
    )
    add_config_options(parser)
    parser.add_argument(
        "--out",
        metavar="F.npz|DIR",
        type=Path,
        help="(default: ./densify-out/flow.npz, of a recording ./densify-out)",
    )
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Scene flow between two point files, or of a recording."""
    config = resolve(options.config, options.overrides)
    if options.data is not None:
        yield from _of_recording(options, config)
        return
    from densify.cli.point_files import check_new_file, read_points, write_flow

    if options.target is None or options.keys is not None or options.all or options.format:
        raise InputError(
            "densify flow: expected SOURCE and TARGET, two point files, or --data SPEC with --all "
            "or --keys A:B[:S]; see densify flow --help"
        )
    options.out = options.out or Path("densify-out/flow.npz")
    check_new_file(options.out, options.overwrite)
    source, target = read_points(options.source), read_points(options.target)
    columns = {
        f"{side}_{name}": getattr(file, name)
        for name in ("offset_ns", "lidar")
        if getattr(source, name) is not None and getattr(target, name) is not None
        for side, file in (("source", source), ("target", target))
    }
    field = densify.estimate_flow(source.points, target.points, config, **columns)
    write_flow(options.out, field)
    num_moving = int(field.moving.sum())
    facts = {"num_points": len(source.points), "num_moving": num_moving}
    text = f"{len(source.points):,} points, {num_moving:,} moving"
    yield Answer(text, facts, [options.out])


def _of_recording(options: argparse.Namespace, config: Config) -> Iterator[Answer]:
    from densify.outputs.flow_writers import flow_writer
    from densify.pipeline.run import flow_steps
    from densify.readers import open_sequence

    if options.source is not None or options.all == (options.keys is not None):
        raise InputError(
            "densify flow --data SPEC: expected either --all or --keys A:B[:S], and no point files"
        )
    sequence, out = open_sequence(options.data), options.out or Path("densify-out")
    frames = list(sequence.frames)
    if options.keys is not None:
        frames = sliced(sequence, options.keys)
    paths: dict[Path, None] = {}
    failed: dict[int, Exception] = {}
    num_moving = 0
    with (
        progress_on_stderr() as progress,
        flow_writer(options.format or "npz", sequence, out, frames, options.overwrite) as write,
    ):
        for frame, flow in flow_steps(sequence, frames, config, progress):
            if isinstance(flow, Exception):
                failed[frame] = flow
                continue
            paths[write(frame, flow)] = None
            num_moving += sum(int(field.moving.sum()) for field in flow.steps.values())
    num_made = len(frames) - len(failed)
    sweeps = "sweep" if num_made == 1 else "sweeps"
    text = f"{num_made:,} {sweeps}, {num_moving:,} points moving"
    facts = {"num_sweeps": num_made, "num_moving": num_moving}
    yield Answer(text, facts, list(dict.fromkeys(path.parent for path in paths)))
    if failed:
        told = "; ".join(f"sweep {frame}: {error}" for frame, error in failed.items())
        raise ComputationError(f"{len(failed)} of {len(frames)} sweeps not made: {told}")
