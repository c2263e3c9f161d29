# SPDX-License-Identifier: MIT
"""Read the raw sweeps of a recording on demand, and cut it into blocks of neighbouring keys."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from uuid import uuid4

from densify.config import RegisterSettings
from densify.config.cache import Cache, digest, get_cached
from densify.config.errors import InputError
from densify.free_space.raw_sweeps import count_by_azimuth
from densify.geometry.types import Float, Int, LidarSequence, Sweep
from densify.pipeline.process import Watch
from densify.readers.timeline import Timeline, check_key, read_sweep

_RENDERED_TOGETHER = 4  # sweeps of the street between two reports of progress
BLOCK_S = 2.0
"""Greatest time from the first key of a block to its last."""


class Sweeps:
    """Reader of raw sweeps that drops the returns of the ego vehicle."""

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
        """Prepare to read sweeps, of which ``num_kept`` are kept in memory.

        Processes of one ``run`` share the digests of sweeps through the cache on disk.
        """
        self._sequence = sequence
        self._timeline = timeline
        self._settings = settings
        self._cache = cache
        self._run = run or uuid4().hex
        self.watch = watch
        self._returns: dict[int, Int] = {}  # frame -> `count_by_azimuth`, of the sweeps read
        self.read = lru_cache(maxsize=num_kept)(self._read)
        self.content = lru_cache(maxsize=None)(self._content)

    def prepare(self, frames: Sequence[int]) -> None:
        """Render the sweeps of these frames in parallel if the recording simulates its sweeps."""
        if not hasattr(self._sequence, "prepare"):  # sweeps are in files
            return
        with self.watch.stage("read"):
            for done in range(0, len(frames), _RENDERED_TOGETHER):
                self.watch.report("read", done, len(frames))
                self._sequence.prepare(frames[done : done + _RENDERED_TOGETHER])

    def recorded_pose(self, frame: int) -> Float | None:
        """Return the recording's ``T_world_lidar`` (4,4); None if the settings ignore the pose."""
        if self._settings.source != "dataset":
            return None
        return self._sequence.T_world_lidar(frame)

    def _read(self, frame: int) -> Sweep:
        """Return a sweep. Raise InputError if it cannot be read."""
        if frame in self._timeline.unknown:
            raise InputError(self._timeline.unknown[frame])
        with self.watch.stage("read", is_part=True):
            sweep = read_sweep(self._sequence, frame, self._settings)
        self._returns[frame] = count_by_azimuth(sweep)
        return sweep

    def returns_by_azimuth(self, frame: int) -> Int:
        """Return the (360,) number of returns of a sweep in each degree of azimuth from -180."""
        if frame not in self._returns:
            self.read(frame)
        return self._returns[frame]

    def _content(self, frame: int) -> str:
        """Return a digest of a sweep and its recorded pose, or the message of its error."""

        def make_digest() -> str:
            try:
                return digest([self.read(frame), self.recorded_pose(frame)])
            except InputError as error:
                return str(error)

        # Processes of a run share the digest, so only one of them reads the sweep.
        inputs = [self._run, self._sequence.name, self._settings, frame]
        return get_cached(self._cache, "digests", lambda: inputs, make_digest)


@dataclass(frozen=True)
class Cut:
    """Blocks of consecutive sweeps that are computed together. Blocks may overlap in time."""

    # Frame numbers of each block, in time order: the windows of its keys, sweeps between and around
    blocks: tuple[tuple[int, ...], ...]
    number_of: Mapping[int, int]  # key -> index of its block

    def keys_of(self, number: int) -> list[int]:
        """Return the keys of the block with index ``number``."""
        return [key for key, block_number in self.number_of.items() if block_number == number]

    @staticmethod
    def of(timeline: Timeline, window: int, keys: Collection[int], beyond_s: float = 0.0) -> Cut:
        """Return the cut of a recording into blocks around the windows of some keys.

        Consecutive keys share a block if their windows overlap and the key is less than `BLOCK_S`
        after the block's first key.

        Args:
            timeline: The recording's sweeps in time.
            window: Number of sweeps on each side of a key.
            keys: Frame numbers of the keys, in any order.
            beyond_s: Seconds by which a block is longer than its windows, on each side.

        Raises:
            InputError: The window or a key is invalid, or a key does not exist.
        """
        for key in keys:
            check_key(key)
        groups = _group_keys(timeline, window, sorted(set(keys)))
        # A block reaches from its first window to its last one, both longer by ``beyond_s``.
        num_beside = window + round(beyond_s * 1e9 / timeline.period_ns)
        blocks = []
        for group in groups:
            first_row = timeline.row[timeline.window(group[0], num_beside).frames[0]]
            last_row = timeline.row[timeline.window(group[-1], num_beside).frames[-1]]
            blocks.append(timeline.frames[first_row : last_row + 1])
        number_of = {key: number for number, group in enumerate(groups) for key in group}
        return Cut(tuple(blocks), number_of)


def _group_keys(timeline: Timeline, window: int, keys: Sequence[int]) -> list[list[int]]:
    """Return ascending keys in groups that share a block."""
    groups: list[list[int]] = []
    last_row = -1  # row of the last sweep in the window of the key before; -1 is before them all
    for key in keys:
        frames = timeline.window(key, window).frames
        overlaps = timeline.row[frames[0]] <= last_row
        since_first_ns = timeline.stamp_of(key) - timeline.stamp_of(groups[-1][0]) if groups else 0
        if overlaps and since_first_ns < BLOCK_S * 1e9:
            groups[-1].append(key)
        else:
            groups.append([key])
        last_row = timeline.row[frames[-1]]
    return groups
