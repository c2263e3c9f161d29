# SPDX-License-Identifier: MIT
"""Sweeps that follow each other so fast that they are taken for one look at what moves.

A scanner that turns twice as fast measures half as many points in a sweep, and an object moves half
as far until the next one: together they show as much as one sweep of the slower scanner does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from densify.flow.tracking.evidence import LINK_M, Standing
from densify.flow.tracking.radial import Radial
from densify.geometry.clock import Clock
from densify.geometry.linking import link

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True)
class Look:
    """What neighbouring sweeps saw, taken together.

    sweeps: their indices. time_ns: the middle of their reference times, since the stretch's first.
    half_s: how far from that they are. seen: what they saw, one sweep's rows after the other's.
    begins: the first row of each.
    """

    sweeps: tuple[int, ...]
    time_ns: int
    half_s: float
    seen: Standing
    begins: tuple[int, ...]

    @staticmethod
    def of(sweeps: Sequence[int], standing: Sequence[Standing], clock: Clock) -> Look:
        parts = [standing[j] for j in sweeps]
        first_ns, last_ns = clock.time_ns[[sweeps[0], sweeps[-1]]].tolist()
        begins = np.cumsum([0] + [len(c.points) for c in parts[:-1]]).tolist()
        middle_ns, half_s = (first_ns + last_ns) // 2, (last_ns - first_ns) * 0.5e-9
        return Look(tuple(sweeps), middle_ns, half_s, _together(parts), tuple(begins))

    def gather(self, columns: Sequence[NDArray[T]]) -> NDArray[T]:
        """(N,...) of what the look saw, from (n,...) of what each sweep of the stretch saw."""
        return np.concatenate([columns[j] for j in self.sweeps])

    def split(self, rows: np.ndarray) -> dict[int, np.ndarray]:
        """Sweep -> which of its own the rows are, of those sweeps that have any."""
        parts = np.split(rows, np.searchsorted(rows, self.begins[1:]))
        own = zip(self.sweeps, parts, self.begins, strict=True)
        return {j: part - begin for j, part, begin in own if len(part)}


def looks_of(standing: Sequence[Standing], clock: Clock) -> tuple[Look, ...]:
    """What the looks of the stretch saw, see `Clock.looks`."""
    return tuple(Look.of(group, standing, clock) for group in clock.looks())


def _together(parts: Sequence[Standing]) -> Standing:
    """As if one sweep had seen it all: clusters of different sweeps are one where they come as
    close to each other as the points of a cluster do."""
    if len(parts) == 1:
        return parts[0]
    first = np.cumsum([0] + [c.num_clusters for c in parts]).tolist()
    label = np.concatenate(
        [np.where(c.candidate, c.cluster + k, -1) for c, k in zip(parts, first[:-1], strict=True)]
    )
    points = np.concatenate([c.points for c in parts])
    candidate = np.flatnonzero(label >= 0)
    num_groups, group = link(points[candidate], LINK_M)
    num = first[-1] + num_groups
    ends = label[candidate], first[-1] + group
    together = coo_array((np.ones(len(candidate), bool), ends), shape=(num, num))
    num_clusters, cluster = connected_components(together, directed=False)
    label[candidate] = cluster[label[candidate]]
    radial = [c.radial for c in parts if c.radial is not None]
    return Standing(
        row=np.concatenate([c.row for c in parts]),
        points=points,
        time_s=np.concatenate([c.time_s for c in parts]),
        seed=np.concatenate([c.seed for c in parts]),
        cluster=label,
        num_clusters=int(num_clusters),
        radial=Radial.together(radial) if len(radial) == len(parts) else None,
    )
