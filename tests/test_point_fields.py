# SPDX-License-Identifier: MIT
"""What fields mean: by the names that drivers give them, and by the times' values."""

from __future__ import annotations

import numpy as np
import pytest

from densify.readers.point_fields import TimeField, find_fields, find_times, full_scale, rescale

STAMP_NS = 1_317_042_661_099_997_611
PERIOD_NS = 100_000_000
FIRED_NS = np.sort(np.random.default_rng(2).integers(0, 99_900_000, 400))

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
