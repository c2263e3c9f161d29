# SPDX-License-Identifier: MIT
"""The sweeps of a recording, read when asked for, and told from others by their content."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from uuid import uuid4

from densify.config import RegisterSettings
from densify.config.cache import Cache, digest
from densify.config.errors import InputError
from densify.geometry.types import Float, LidarSequence, MakesFrames, Sweep
from densify.pipeline.costs import Watch
from densify.readers.timeline import Timeline
from densify.readers.window import read_sweep
from densify.registration.trajectory import LeftOut

_DIGESTS_TOGETHER = 20


class Sweeps:
    """num_kept: as many sweeps stay in memory. cache: None where nothing is kept on disk. run: the
    same for all processes between which no sweep changes; None for this object alone."""

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
        self._sequence, self._timeline, self._settings = sequence, timeline, settings
        self._cache, self._run, self._watch = cache, run or uuid4().hex, watch
        self._digests = lru_cache(maxsize=None)(self._find_digests)
        self.read = lru_cache(maxsize=num_kept)(self._read)

    def content(self, frame: int) -> str:
        """A digest of a sweep's content, "" where there is no cache. Raises InputError if the sweep
        cannot be read."""
        if self._cache is None:
            self.read(frame)
            return ""
        found = self._digests(self._timeline.row[frame] // _DIGESTS_TOGETHER)[frame]
        if isinstance(found, LeftOut):
            raise InputError(found.reason)
        return found

    def content_if_readable(self, frame: int) -> str:
        """A digest of a sweep's content; of one that cannot be read, why."""
        try:
            return self.content(frame)
        except InputError as error:
            return str(error)

    def prepare(self, frames: Sequence[int]) -> None:
        """Have a recording that makes its sweeps make these, side by side."""
        if isinstance(self._sequence, MakesFrames):
            with self._watch.stage("read"):
                self._sequence.prepare(frames)

    def recorded_pose(self, frame: int) -> Float | None:
        """(4,4) the recording's own ``T_world_lidar``, None where its poses are not asked for.
        Raises InputError if there is none."""
        if self._settings.source != "dataset":
            return None
        return self._sequence.T_world_lidar(frame)

    def _read(self, frame: int) -> Sweep:
        if frame in self._timeline.unknown:
            raise InputError(self._timeline.unknown[frame])
        with self._watch.stage("read"):
            return read_sweep(self._sequence, frame, self._settings)

    def _find_digests(self, number: int) -> dict[int, str | LeftOut]:
        """Digests by frame; all processes of a run look them up, only the first has to read."""
        first = number * _DIGESTS_TOGETHER

        def read() -> dict[int, str | LeftOut]:
            found: dict[int, str | LeftOut] = {}
            for frame in self._timeline.frames[first : first + _DIGESTS_TOGETHER]:
                try:
                    found[frame] = digest(self._read(frame))
                except InputError as error:
                    found[frame] = LeftOut(str(error), unreadable=True)
            return found

        if self._cache is None:
            return read()
        inputs = [self._run, self._sequence.name, self._settings, number]
        return self._cache.get("digests", dict[int, str | LeftOut], inputs, read)
