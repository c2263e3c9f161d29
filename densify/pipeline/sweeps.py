# SPDX-License-Identifier: MIT
"""The raw sweeps of a recording, read on demand, and identified by a digest of their content."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from uuid import uuid4

from densify.config import RegisterSettings
from densify.config.cache import Cache, digest, kept
from densify.config.errors import InputError
from densify.geometry.types import Float, LidarSequence, Sweep
from densify.pipeline.costs import Watch
from densify.readers.timeline import Timeline, read_sweep


class Sweeps:
    """Reads sweeps, without the own vehicle's returns."""

    def __init__(
        self,
        sequence: LidarSequence,
        timeline: Timeline,
        settings: RegisterSettings,
        num_kept: int,
        cache: Cache | None,
        run: str | None,
        watch: Watch,
    ) -> None:
        """num_kept: sweeps that stay in memory. cache: on disk, if any. run: the same text for
        all processes between which no sweep changes; None for this object alone."""
        self._sequence, self._timeline, self._settings = sequence, timeline, settings
        self._cache, self._run, self._watch = cache, run or uuid4().hex, watch
        self.read = lru_cache(maxsize=num_kept)(self._read)
        self.content = lru_cache(maxsize=None)(self._content)

    def prepare(self, frames: Sequence[int]) -> None:
        """Let a recording that makes its sweeps make these side by side."""
        if hasattr(self._sequence, "prepare"):
            with self._watch.stage("read"):
                self._sequence.prepare(frames)

    def recorded_pose(self, frame: int) -> Float | None:
        """Return the recording's own ``T_world_lidar`` (4,4), None where it is not used.

        Raises InputError if there is none.
        """
        if self._settings.source != "dataset":
            return None
        return self._sequence.T_world_lidar(frame)

    def _read(self, frame: int) -> Sweep:
        """Raises InputError if the sweep cannot be read."""
        if frame in self._timeline.unknown:
            raise InputError(self._timeline.unknown[frame])
        with self._watch.stage("read"):
            return read_sweep(self._sequence, frame, self._settings)

    def _content(self, frame: int) -> str:
        """Return a digest of a sweep and its recorded pose, or why they cannot be read.

        All processes of a run look it up in the cache; only the first has to read the sweep.
        """

        def find() -> str:
            try:
                return digest([self._read(frame), self.recorded_pose(frame)])
            except InputError as error:
                return str(error)

        inputs = [self._run, self._sequence.name, self._settings, frame]
        return kept(self._cache, "digests", str, lambda: inputs, find)
