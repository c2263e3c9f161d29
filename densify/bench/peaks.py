# SPDX-License-Identifier: MIT
"""Peak memory of runs, each in a process of its own, beside what `densify.pipeline.memory` says
before."""

from __future__ import annotations

import multiprocessing
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from densify.config import Config, as_mapping, resolve
from densify.config.errors import ComputationError
from densify.geometry.types import LidarSequence, MakesFrames
from densify.outputs import write_result
from densify.pipeline import memory
from densify.pipeline import run as pipeline
from densify.pipeline.costs import peak_memory_mb
from densify.readers import open_sequence

SENSORS = {16: "vlp16", 32: "hdl32", 64: "hdl64", 128: "vls128"}
"""Rings -> the street's scanner with so many."""
WINDOWS, NUM_CAMERAS, RINGS = (1, 5, 20, 50), (1, 2, 4, 6), (16, 64, 128)
_USUAL = (64, 5, 1)


def grid(
    windows: Sequence[int] = WINDOWS,
    num_cameras: Sequence[int] = NUM_CAMERAS,
    rings: Sequence[int] = RINGS,
) -> list[tuple[int, int, int]]:
    """Rings, window and cameras, one of them other than usual at a time."""
    usual_rings, usual_window, usual_cameras = _USUAL
    cases = [
        *((usual_rings, window, usual_cameras) for window in windows),
        *((usual_rings, usual_window, num) for num in num_cameras),
        *((num, usual_window, usual_cameras) for num in rings),
    ]
    return list(dict.fromkeys(cases))


def bench_memory(
    key: int,
    config: Config,
    cases: Sequence[tuple[int, int, int]],
    progress: Callable[[str, int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Measure each case of `grid`: "rings", "window", "cameras", "points" of the key, "peak_gb" of
    a run on the built-in street that writes its files, "said_gb" by `memory.need_of_run`."""
    rows = []
    for done, (rings, window, num_cameras) in enumerate(cases):
        if progress:
            progress("memory", done, len(cases))
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        spec = f"street?sensor={SENSORS[rings]}"
        arguments = (theirs, spec, key, window, num_cameras, as_mapping(config))
        child = context.Process(target=_measured, args=arguments)
        child.start()
        theirs.close()
        try:
            num_points, said_bytes, peak_bytes = ours.recv()
        except EOFError as error:
            raise ComputationError(
                f"bench memory: the run with {rings} rings, window {window} and {num_cameras} "
                f"cameras died"
            ) from error
        finally:
            child.join()
        rows.append(
            {
                "rings": rings,
                "window": window,
                "cameras": num_cameras,
                "points": num_points,
                "peak_gb": peak_bytes / 1e9,
                "said_gb": said_bytes / 1e9,
            }
        )
    return rows


def _measured(
    told: Connection,
    spec: str,
    key: int,
    window: int,
    num_cameras: int,
    config: Mapping[str, Any],
) -> None:
    sequence = _WithCameras(open_sequence(spec), num_cameras)
    said_bytes = memory.need_of_run(sequence, key, window, None, resolve(config))
    result = pipeline.run(sequence, key, window, config=config)
    with tempfile.TemporaryDirectory() as folder:
        write_result(result, result.images, Path(folder), config=config, data=spec)
    told.send((len(sequence[key]), said_bytes, peak_memory_mb() * 2**20))


class _WithCameras:
    """A recording with its first camera several times."""

    def __init__(self, sequence: LidarSequence, num: int) -> None:
        self._sequence = sequence
        (self._name, camera), *_ = sequence.cameras.items()
        names = [f"{self._name}_{number}" for number in range(num)]
        self.cameras = {name: replace(camera, name=name) for name in names}
        self.truth = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sequence, name)

    def __getitem__(self, frame: int) -> Any:
        return self._sequence[frame]

    def prepare(self, frames: Sequence[int], images: Sequence[tuple[str, int]] = ()) -> None:
        if isinstance(self._sequence, MakesFrames):
            self._sequence.prepare(frames, [(self._name, number) for _, number in images])

    def image_stamps_ns(self, camera: str) -> Any:
        return self._sequence.image_stamps_ns(self._name)

    def image(self, camera: str, number: int) -> NDArray[Any]:
        return self._sequence.image(self._name, number)
