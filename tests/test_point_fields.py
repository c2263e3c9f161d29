# SPDX-License-Identifier: MIT
"""What fields mean: by the names that drivers give them, and by the times' values; broken
times cost their points, and odd ones are read as they are meant."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from densify.config.errors import InputError
from densify.readers import describe, open_sequence
from densify.readers.point_fields import TimeField, find_fields, find_times, full_scale, rescale
from densify.readers.timeline import Timeline
from tests.ros_bags import PERIOD_NS, STAMP_NS, Maker, scan

NUM = 400
FIRED_NS = np.arange(NUM) * (PERIOD_NS // NUM)

DRIVERS = {  # names: those of intensity, time, ring
    "x y z intensity ring time": ("intensity", "time", "ring"),
    "x y z intensity t reflectivity ring ambient range": ("intensity", "t", "ring"),
    "x y z reflectivity tag line offset_time": ("reflectivity", "offset_time", "line"),
    "X Y Z I RETURN_TYPE CHANNEL TIME_STAMP": ("I", "TIME_STAMP", "CHANNEL"),
    "x y z scalar_Intensity scalar_Ring": ("scalar_Intensity", "", "scalar_Ring"),
    "x y z": ("", "", ""),
}


@pytest.mark.parametrize("names", DRIVERS)
def test_fields_of_drivers(names: str) -> None:
    fields = find_fields(names.split())
    assert tuple(fields.get(key, "") for key in ("intensity", "time", "ring")) == DRIVERS[names]
    assert [fields[axis].lower() for axis in "xyz"] == ["x", "y", "z"]


TIMES = {  # values, unit, absolute, ms of the first point after the stamp
    "velodyne": ((FIRED_NS * 1e-9).astype("f4"), "s", False, 0),
    "velodyne before the stamp": ((FIRED_NS * 1e-9 - 0.1).astype("f4"), "s", False, -100),
    "around the stamp": ((FIRED_NS * 1e-9 - 0.05).astype("f4"), "s", False, -50),
    "whole ns before the end": ((FIRED_NS - PERIOD_NS).astype("i4"), "ns", False, -100),
    "half a revolution": ((FIRED_NS * 0.5e-9).astype("f4"), "s", False, 0),
    "ouster": (FIRED_NS.astype("u4"), "ns", False, 0),
    "microseconds": ((FIRED_NS // 1000).astype("u4"), "us", False, 0),
    "milliseconds": ((FIRED_NS * 1e-6).astype("f4"), "ms", False, 0),
    "hesai": ((STAMP_NS + FIRED_NS) * 1e-9, "s", True, 0),
    "robosense in us": ((STAMP_NS + FIRED_NS) // 1000, "us", True, 0),
    "absolute ns": ((STAMP_NS + FIRED_NS).astype("u8"), "ns", True, 0),
    "absolute ns as floats": ((STAMP_NS + FIRED_NS).astype("f8"), "ns", True, 0),
}


@pytest.mark.parametrize("kind", TIMES)
def test_units_follow_from_the_span(kind: str) -> None:
    values, unit, absolute, first_ms = TIMES[kind]
    times, words = find_times(TimeField("t"), [values], PERIOD_NS, [STAMP_NS])
    assert times is not None, words
    assert (times.unit, times.absolute, times.other_clock) == (unit, absolute, False)
    assert f"t in {unit}, {'absolute' if absolute else 'relative'}" in words
    offset_ns, is_valid = times.offset_ns(values, STAMP_NS)
    assert is_valid.all() and offset_ns.dtype == np.int64
    expected_ns = FIRED_NS * (0.5 if "half" in kind else 1) + first_ms * 1e6
    assert np.abs(offset_ns - expected_ns).max() < 1200  # digits of the floats, and whole us


@pytest.mark.parametrize(("reference", "share"), [("start", 0), ("middle", 0.5), ("end", 1)])
def test_the_stamp_may_be_the_end_or_the_middle(reference: str, share: float) -> None:
    values = (FIRED_NS - FIRED_NS[0]).astype("u4")
    field = TimeField("t", reference=reference)
    times, words = find_times(field, [values], PERIOD_NS, [STAMP_NS])
    assert times is not None and f"the stamp is the {reference}" in words
    expected_ns = values - share * values[-1].astype(float)
    np.testing.assert_allclose(times.offset_ns(values, STAMP_NS)[0], expected_ns, atol=1)


def test_another_clock_is_told_and_counted_from_the_first_point() -> None:
    tai_ns = STAMP_NS + 37_000_000_000 + FIRED_NS
    times, words = find_times(TimeField("timestamp"), [tai_ns], PERIOD_NS, [STAMP_NS])
    assert times is not None and times.other_clock and "another clock" in words
    np.testing.assert_array_equal(times.offset_ns(tai_ns, STAMP_NS)[0], FIRED_NS - FIRED_NS[0])


def test_times_far_from_the_sweep_are_invalid() -> None:
    values = (STAMP_NS + FIRED_NS) * 1e-9
    wrong = [3, 50, 51, 52]
    values[wrong] = np.nan, 0.0, 1e300, values[0] + 60
    times, words = find_times(TimeField("t"), [values], PERIOD_NS, [STAMP_NS])
    assert times is not None, words
    offset_ns, is_valid = times.offset_ns(values, STAMP_NS)
    assert np.flatnonzero(~is_valid).tolist() == wrong and not offset_ns[wrong].any()
    assert times.own_stamp_ns(values) == pytest.approx(STAMP_NS + FIRED_NS[0], abs=300)
    assert times.own_stamp_ns(values[:0]) is None


NOT_TIMES = {
    "the same for all": (np.full(9, 0.5), "the same for all"),
    "seconds since 1970 as float32": (((STAMP_NS + FIRED_NS) * 1e-9).astype("f4"), "the same"),
    "too few digits": ((1e6 + FIRED_NS * 1e-9).astype("f4"), "too few digits"),
    "no unit fits": (np.linspace(0, 5.0, 50), "name its unit"),
}


@pytest.mark.parametrize("kind", NOT_TIMES)
def test_what_tells_no_times_says_why(kind: str) -> None:
    values, says = NOT_TIMES[kind]
    times, words = find_times(TimeField("t"), [values], PERIOD_NS, [STAMP_NS])
    assert times is None and says in words


def test_a_unit_that_is_known_is_taken() -> None:
    """A sweep without a time that is finite tells nothing."""
    values = np.linspace(0, 30.0, 50)
    field, sweeps = TimeField("t", "ms", absolute=False), [values, values * np.nan]
    times, _ = find_times(field, sweeps, PERIOD_NS, [STAMP_NS, STAMP_NS + PERIOD_NS])
    assert times is not None and times.offset_ns(values, STAMP_NS)[0][-1] == 30_000_000


def test_intensities_are_brought_to_one() -> None:
    for values, scale in (([0, 0.4, 1], 1), ([0, 7, 200], 255), ([0, 256], 65535), ([1e6], 1e6)):
        intensity = np.array(values, np.float32)
        assert full_scale(intensity) == scale
        assert rescale(intensity, scale).max() <= 1
    clipped = rescale(np.array([np.nan, 300, 51.0]), 255)
    np.testing.assert_array_equal(clipped, [0, 1, np.float32(0.2)])


# --- recordings -----------------------------------------------------------------------------------


def bag(folder: Path, times: Callable[[int], np.ndarray], num: int = 7, **options) -> Path:
    """A bag of ``num`` sweeps; times: (NUM,) of the points of sweep i."""
    maker = Maker()
    for i in range(num):
        columns = scan(NUM) | {"t": times(i)}
        maker.cloud(columns, STAMP_NS + i * PERIOD_NS, **options)
    return maker.write(folder)


def folder(path: Path, times: Callable[[int], np.ndarray], num: int = 7) -> Path:
    """A folder of numbered arrays with a float64 ``timestamp``."""
    path.mkdir(exist_ok=True)
    rows = np.zeros(NUM, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<f8")])
    for axis in "xyz":
        rows[axis] = scan(NUM)[axis]
    for i in range(num):
        rows["timestamp"] = times(i)
        np.save(path / f"{i:06d}.npy", rows)
    return path


def broken(sweep: int, share: float, time_s: float) -> Callable[[int], np.ndarray]:
    """Relative times (s) of which one sweep has a share of wrong ones."""
    wrong = np.arange(NUM) % 100 < 100 * share
    return lambda i: np.where(wrong & (i == sweep), time_s, FIRED_NS * 1e-9).astype("f4")


@pytest.mark.parametrize(
    ("sweep", "share", "time_s"), [(0, 0.3, 3.6), (3, 0.6, 3.6), (6, 0.3, -0.5), (3, 0.02, np.nan)]
)
def test_points_with_times_of_another_sweep_are_left_out(sweep, share, time_s, tmp_path):
    sequence = open_sequence(bag(tmp_path, broken(sweep, share, time_s)))
    for frame in sequence.frames:
        found = sequence[frame]
        num_wrong = round(NUM * share) * (frame == sweep)
        assert (len(found), found.num_untimed) == (NUM - num_wrong, num_wrong)
        np.testing.assert_allclose(found.offset_ns, FIRED_NS[found.row], atol=10)
    wrong = f"{round(NUM * share)} more left out"
    assert (wrong in describe(sequence)) == (sweep in (0, 6))


def test_a_sweep_of_wrong_times_alone_is_named(tmp_path):
    sequence = open_sequence(bag(tmp_path, broken(2, 1.0, 3.6)))
    # all alike, they tell nothing: the sweep has no times
    assert sequence[2].offset_ns is None and sequence[3].offset_ns is not None
    place = bag(tmp_path / "again", lambda i: (FIRED_NS * 1e-9 + 3.6 * (i == 2)).astype("f4"))
    with pytest.raises(InputError, match=r"none valid, 400 with a time of another sweep"):
        _ = open_sequence(place)[2]


def test_offsets_that_wrapped_are_left_out_of_every_sweep(tmp_path):
    wrapped_ns = (FIRED_NS - 5_000_000).astype(np.int64) % 2**32  # 4.29 s
    sequence = open_sequence(bag(tmp_path, lambda i: wrapped_ns.astype("u4")))
    sweep = sequence[4]
    assert sweep.num_untimed == 20 and sweep.offset_ns.max() == FIRED_NS[-1] - 5_000_000


@pytest.mark.parametrize("height", [8, NUM // 8])
def test_times_go_with_their_points_whatever_the_rows_are(height, tmp_path):
    """A scan of 8 rings, written ring by ring (each row goes all around) or firing by firing."""
    rows = np.arange(NUM)
    ring, firing = divmod(rows, NUM // 8) if height == 8 else divmod(rows, 8)[::-1]
    fired_ns = firing * (PERIOD_NS // (NUM // 8)) + 1000 * ring
    sequence = open_sequence(bag(tmp_path, lambda i: fired_ns.astype("u4"), 3, height=height))
    np.testing.assert_array_equal(sequence[1].offset_ns, fired_ns)


def test_stamps_are_those_of_the_points_where_nothing_else_tells(tmp_path):
    def times(i: int) -> np.ndarray:
        at_s = 1_700_000_000 + 0.05 * i + FIRED_NS * 0.5e-9
        return np.where(np.arange(NUM) == 7, 0.0, at_s)  # one without a time

    place = folder(tmp_path / "drive", times)
    rows = [f"{1_700_000_000 + 0.05 * i:.9f} {i} 0 0 0 0 0 1" for i in range(-1, 10)]  # 20 m/s
    (place / "poses.txt").write_text("\n".join(rows))
    sequence = open_sequence(place)
    stamps_ns = [sequence.stamp_ns(frame) for frame in sequence.frames]
    np.testing.assert_allclose(np.diff(stamps_ns), 50_000_000, atol=600)
    assert abs(stamps_ns[0] - STAMP_NS) < 600
    found = sequence[3]
    assert found.num_untimed == 1
    np.testing.assert_allclose(found.offset_ns, 0.5 * FIRED_NS[found.row], atol=600)
    np.testing.assert_allclose(sequence.T_world_lidar(3)[0, 3], 3, atol=1e-4)
    assert dict(sequence.findings())["stamped by"] == "the times of the points (timestamp)"
    assert not sequence.gaps()


@pytest.mark.parametrize(
    ("start_s", "text", "reference_ns"),
    [(0.0, "", 0), (1.7e9, "sweeps: {reference: end}", FIRED_NS[-1])],
)
def test_times_since_any_epoch_are_stamps(start_s, text, reference_ns, tmp_path):
    """Of the log too; the stamp may be the end of the points' times."""
    place = folder(tmp_path / "drive", lambda i: start_s + 0.1 * i + FIRED_NS * 1e-9)
    (place / "densify.yaml").write_text(text)
    sequence = open_sequence(place)
    stamps_ns = np.array([sequence.stamp_ns(f) for f in sequence.frames])
    since_ns = stamps_ns - int(start_s) * 10**9 - reference_ns
    np.testing.assert_allclose(since_ns, np.arange(7) * 10**8, atol=600)
    np.testing.assert_allclose(sequence[5].offset_ns, FIRED_NS - reference_ns, atol=600)
    (place / "000002.npy").write_bytes(b"")  # costs its sweep alone
    assert list(Timeline.of(open_sequence(place)).unknown) == [2]


def test_a_rate_that_is_assumed_is_told(tmp_path):
    place = folder(tmp_path / "drive", lambda i: FIRED_NS * 1e-9)
    (told,) = open_sequence(place).gaps()
    assert "no stamps: they are taken for 10 Hz by their numbers" in told
    (place / "densify.yaml").write_text("sweeps: {rate_hz: 20}")
    assert not open_sequence(place).gaps()
