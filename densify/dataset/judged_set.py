# SPDX-License-Identifier: MIT
"""Judge the keys of a training set by their scores: the worst keys, suspects, costs of limits.

A key is as bad as its worst score. Scores compare by their distance from the median of the set, in
widths of the range that is usual on KITTI. A key is suspect if its errors lie beyond the fence of
the usual ones, or its coverage beyond the fence around the median of its camera in the set (Tukey,
"Exploratory Data Analysis", 1977: quartiles and 1.5 of their distance, 2.7 standard deviations of a
normal distribution). Coverage itself depends on scanner, camera and speed: no range fits all sets.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from densify.dataset.manifest import USUAL_SHARES, Key, KeyRecord, read_manifests
from densify.dataset.plan import Drive, drives_of, read_plan

_FENCE, _END = 2.698, 1.645  # standard deviations, to a fence and to an end of 5 to 95 %
_SHARES_LOST = (0.0, 0.05, 0.1)  # shares of the keys that limits put aside; 0 is a single key
_NUMBER = re.compile(r"\d+(?:[.,:/-]\d+)*")


class Score(NamedTuple):
    """A score of a key."""

    name: str  # name in a manifest line
    title: str
    is_bad: int  # 1 if a high value is bad, -1 if a low value is
    is_error: bool  # False if only the distance from the other keys counts
    limit: str = ""  # name of the limit in the recipe
    unit: str = "%"
    num_digits: int = 2

    def text(self, value: float | None) -> str:
        """Return a value without its unit, "" if unknown."""
        return "" if value is None else f"{value:.{self.num_digits}f}"

    def by_camera(self, record: KeyRecord) -> dict[str, float]:
        """Return camera -> the known score of a key in ``unit``, of the camera's worst image.

        The camera of a score without cameras is "".
        """
        if self.name == "seconds":
            return {"": record.seconds}
        value = record.scores.get(self.name)
        worst: dict[str, float] = {}
        for name, share in (value if isinstance(value, Mapping) else {"": value}).items():
            if share is not None:
                camera, percent = name.partition("/")[0], 100 * share
                both = worst.get(camera, percent), percent
                worst[camera] = max(both) if self.is_bad > 0 else min(both)
        return worst

    def usual(self) -> list[float]:
        """Return the ends of the range on KITTI in ``unit``, [] if unknown."""
        return [100 * share for share in USUAL_SHARES.get(self.name, ())]


SCORES = (
    Score("ghost", "Ghosts", 1, True, "max_ghost"),
    Score("outliers", "Held-out outliers", 1, True, "max_outliers"),
    Score("outliers_moving", "Held-out outliers, moving", 1, True),
    Score("outliers_filled", "Held-out outliers, filled", 1, True),
    Score("expected_outliers", "Expected outliers", 1, True),
    Score("density", "Measured depth", -1, False, "min_density", num_digits=1),
    Score("density_filled", "Filled depth", -1, False, num_digits=1),
    Score("moving", "Moving points", 1, False),
    Score("seconds", "Computing time", 1, False, unit="s", num_digits=1),
)


class Series(NamedTuple):
    """A score of one camera, or of all of a key."""

    score: Score
    camera: str  # "" for a score that has no cameras

    def of(self, record: KeyRecord) -> float | None:
        """Return the score of a key in the score's unit, of the worst image; None if unknown."""
        return self.score.by_camera(record).get(self.camera)


class Judgement(NamedTuple):
    """How bad a score of a key is, compared with the other keys of the set."""

    distance: float  # from the median of the set, in widths of the usual range
    series: Series
    value: float
    median: float
    bound: float  # beyond which a key is suspect
    is_suspect: bool

    def reason(self, with_camera: bool) -> str:
        """Return why the key is suspect as text, with the name of the camera if asked for."""
        if not self.series.score.is_error:
            return self.comparison(with_camera)
        return self._beside("usual up to", self.bound, with_camera)

    def comparison(self, with_camera: bool) -> str:
        """Return the value beside the median of the set as text."""
        return self._beside("median", self.median, with_camera)

    def _beside(self, title: str, other: float, with_camera: bool) -> str:
        score = self.series.score
        camera = f" of {self.series.camera}" if with_camera and self.series.camera else ""
        value = f"{score.title.lower()}{camera} {score.text(self.value)} {score.unit}"
        return f"{value}, {title} {score.text(other)} {score.unit}"


class Limit(NamedTuple):
    """A limit of a training set, and the keys that it puts aside."""

    setting: str
    num_lost: int


class JudgedSet(NamedTuple):
    """The keys of a training set with their judgements."""

    root: Path
    table: Mapping[str, Any]  # content of dataset.json
    drives: Mapping[str, Drive]
    records: Sequence[KeyRecord]  # ordered by recording and frame
    worst_first: Sequence[KeyRecord]  # the keys that are done
    worst: Mapping[Key, Judgement]  # the worst score of each key that is made
    suspects: Mapping[Key, Sequence[Judgement]]  # suspect scores of the suspect keys that are done
    series: Sequence[Series]  # the scores that a key of the set has, by camera
    bounds: Mapping[Series, float]  # value beyond which a key is suspect

    @property
    def cameras(self) -> list[str]:
        """The names of the cameras that have scores."""
        return sorted({series.camera for series in self.series if series.camera})

    @property
    def scores(self) -> list[Score]:
        """The scores that a key of the set has."""
        return [score for score in SCORES if any(s.score is score for s in self.series)]

    def values(self, series: Series) -> list[float]:
        """Return the known values of the keys that are done."""
        return [value for record in self.worst_first if (value := series.of(record)) is not None]

    def name_of(self, record: KeyRecord) -> str:
        """Return a key's name, with the recording if there are several."""
        return f"{record.drive}, key {record.key}" if len(self.drives) > 1 else f"key {record.key}"

    def worst_value(self, score: Score, record: KeyRecord) -> tuple[float | None, str]:
        """Return a score of the key's worst camera, None if unknown, and the camera of several."""
        known = score.by_camera(record)
        if not known:
            return None, ""
        camera = max(known, key=lambda name: score.is_bad * known[name])
        return known[camera], camera if len(self.cameras) > 1 else ""

    def is_suspect_in(self, score: Score, record: KeyRecord) -> bool:
        """Return True if the score makes the key suspect, of any camera."""
        return any(j.series.score is score for j in self.suspects.get(record.name, ()))

    def worst_moments(self, num_keys: int) -> list[KeyRecord]:
        """Return at most this number of the worst keys, one of those that share half a window."""
        chosen: list[KeyRecord] = []
        reach = self.table["window"]
        for record in self.worst_first:
            if len(chosen) == num_keys:
                break
            if not any(
                r.drive == record.drive and abs(r.key - record.key) <= reach for r in chosen
            ):
                chosen.append(record)
        return chosen


def suspects_of(records: Sequence[KeyRecord]) -> dict[Key, list[Judgement]]:
    """Return the suspect scores, the worst first, of the suspect keys among those that are made.

    Keys that were put aside count too: the others are judged as before.
    """
    return _suspects(_judge_all(records))


def _suspects(judgements: Mapping[Key, Sequence[Judgement]]) -> dict[Key, list[Judgement]]:
    """Return the suspect scores, the worst first, of the keys that have some."""
    ordered = {
        name: [j for j in sorted(of_key, key=_badness, reverse=True) if j.is_suspect]
        for name, of_key in judgements.items()
    }
    return {name: found for name, found in ordered.items() if found}


def read_judged(root: Path) -> JudgedSet:
    """Read the plan and the manifests of a training set, and judge its keys."""
    table = read_plan(root) or {}
    drives = drives_of(table)
    records = [record for record in read_manifests(root).values() if record.drive in drives]
    done = [record for record in records if record.status == "done"]
    names = {series for record in records for series in _series_of(record)}
    order = {score.name: row for row, score in enumerate(SCORES)}
    series = sorted(names, key=lambda s: (order[s.score.name], s.camera))
    all_judgements = _judge_all(records)
    worst = {name: max(judgements, key=_badness) for name, judgements in all_judgements.items()}
    kept = {record.name for record in done}
    bounds = {j.series: j.bound for judgements in all_judgements.values() for j in judgements}

    def badness(record: KeyRecord) -> tuple[bool, float]:
        return _badness(worst[record.name]) if record.name in worst else (False, -np.inf)

    return JudgedSet(
        root,
        table,
        drives,
        records,
        sorted(done, key=badness, reverse=True),
        worst,
        {name: found for name, found in _suspects(all_judgements).items() if name in kept},
        series,
        bounds,
    )


def _series_of(record: KeyRecord) -> Iterable[Series]:
    """Return the scores that a key has, by camera."""
    for score in SCORES:
        yield from (Series(score, camera) for camera in score.by_camera(record))


def _judge_all(records: Sequence[KeyRecord]) -> dict[Key, list[Judgement]]:
    """Return the judgements of all scores of each key that is made and has one."""
    made = [record for record in records if record.status != "failed"]
    judgements: dict[Key, list[Judgement]] = {}
    for series in {series for record in made for series in _series_of(record)}:
        if not (usual := series.score.usual()):
            continue
        low, high = usual
        values = {r.name: value for r in made if (value := series.of(r)) is not None}
        median = float(np.median([*values.values()]))
        is_bad = series.score.is_bad
        middle, scale = (low + high) / 2, 1.0
        if not series.score.is_error:  # as shares of the camera's median
            middle, scale = median, median / middle
        bound = middle + is_bad * _FENCE * scale * (high - low) / (2 * _END)
        for name, value in values.items():
            distance = is_bad * (value - median) / (max(scale, 1e-9) * (high - low))
            is_suspect = is_bad * (value - bound) > 0
            judgement = Judgement(distance, series, value, median, bound, is_suspect)
            judgements.setdefault(name, []).append(judgement)
    return judgements


def _badness(judgement: Judgement) -> tuple[bool, float]:
    return judgement.is_suspect, judgement.distance


def limits_of(judged: JudgedSet) -> list[Limit]:
    """Return limits that put one key, about 5 and about 10 % of the keys aside."""
    limits = {}
    for score in (score for score in SCORES if score.limit):
        known = (judged.worst_value(score, record)[0] for record in judged.worst_first)
        values = sorted(score.is_bad * value for value in known if value is not None)
        for share in _SHARES_LOST:
            num_wanted = max(1, round(share * len(values)))
            if num_wanted >= len(values):
                continue
            kept = values[-1 - num_wanted]  # the worst value within the limit
            step = 10.0 ** (np.floor(np.log10(max(abs(kept), 1e-9))) - 1)  # of two digits
            bound = float(np.ceil(kept / step - 1e-9) * step)
            num_lost = sum(value > bound for value in values)
            if num_lost:
                setting = f"dataset.{score.limit}={abs(bound) / 100:.4g}"
                limits[setting] = Limit(setting, num_lost)
    return list(limits.values())


def count_messages(records: Iterable[KeyRecord]) -> list[tuple[str, list[KeyRecord]]]:
    """Return (message, keys) for the reasons and warnings, the most frequent first.

    Messages that differ in their numbers alone count as one, without these numbers.
    """
    groups: dict[str, tuple[str, list[KeyRecord]]] = {}
    for record in records:
        status = "" if record.status == "done" else f"{record.status}: {record.reason}"
        for text in filter(None, [status, *record.warnings]):
            same = _NUMBER.sub("…", text)
            first, keys = groups.get(same, (text, []))
            groups[same] = (first if text == first else same, [*keys, record])
    return sorted(groups.values(), key=lambda group: -len(group[1]))
