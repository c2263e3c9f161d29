# SPDX-License-Identifier: MIT
"""``densify simulate``: write the built-in street as a recording."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from densify.cli.answer import Answer
from densify.cli.options import (
    add_camera,
    add_overwrite,
    add_recording,
    add_verb,
    frame_range,
    recording_of,
)
from densify.cli.progress import progress_on_stderr
from densify.config.errors import InputError

if TYPE_CHECKING:
    from densify.geometry.types import LidarSequence


def add(commands: Any) -> None:
    """Its options."""
    about = "write the built-in street as a recording with exact ground truth"
    parser = add_verb(commands, "simulate", answer, about)
    add_recording(parser)
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder to make")
    parser.add_argument(
        "--format",
        default="kitti",
        metavar="NAME",
        help="kitti (a raw drive, default) or folder (numbered sweeps with densify.yaml)",
    )
    parser.add_argument(
        "--frames", type=frame_range, metavar="A:B", help="frames A to B-1 only (default: all)"
    )
    add_camera(parser)
    add_overwrite(parser)


def answer(options: argparse.Namespace) -> Iterator[Answer]:
    """Write the street and say where it is."""
    from densify.outputs.simulated_street import write_street
    from densify.readers.street import Street

    street = Street.from_spec(recording_of(options))
    frames = _frames_of(street, options.frames)
    with progress_on_stderr() as progress:
        place = write_street(
            options.format,
            street,
            options.out,
            frames,
            options.cameras,
            progress,
            overwrite=options.overwrite,
        )
    text = f"{len(frames)} frames; open them with --data {place}"
    yield Answer(text, {"data": str(place), "num_frames": len(frames)})


def _frames_of(street: LidarSequence, wanted: range | None) -> list[int]:
    frames = list(street.frames)
    if wanted is None:
        return frames
    if wanted[0] < frames[0] or wanted[-1] > frames[-1]:
        raise InputError(
            f"--frames {wanted.start}:{wanted.stop}: expected frames within "
            f"{frames[0]}:{frames[-1] + 1}"
        )
    return list(wanted)
