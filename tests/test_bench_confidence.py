# SPDX-License-Identifier: MIT
"""The tables behind confidence: fitted to evidence drawn from known ones, and by the verb."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from densify.bench import confidence as bench
from densify.cli import main
from densify.cli.options import recording_keys
from densify.depth import confidence as scale

NUM_DRAWN = 1_200_000


def drawn(seed: int, tables, num=NUM_DRAWN, source="truth") -> bench.Evidence:
    """A map of ``num`` pixels, evenly of all groups and ranks, an eighth of them contradicted by
    .3, the others by .01, wrong as ``tables`` (G,2,R) say."""
    rng = np.random.default_rng(seed)
    num_groups, _, num_ranks = tables.shape
    shown = rng.poisson(num / (num_groups * num_ranks) / 8, (8, num_groups, num_ranks))
    contradicted = np.where(np.arange(8) == 0, 0.3, 0.01)[:, None, None]
    share = tables[:, 0] + contradicted * tables[:, 1]
    place, group, step = np.nonzero(wrong := rng.binomial(shown, share))
    of = np.repeat(np.arange(len(place)), wrong[place, group, step])
    pixels = np.stack([shown.sum(axis=0), (shown * contradicted).sum(axis=0)], axis=1)
    found = bench.WrongPixels(group[of], step[of], contradicted[place[of], 0, 0])
    return bench.Evidence("drawn", seed, "front", source, pixels, pixels, found)


def known(better: float = 0.0) -> np.ndarray:
    """(G,2,R) shares: each group and cause another, falling with the rank."""
    at_zero = np.array([[0.01, 0.6], [0.02, 0.4], [0.03, 0.9]] * 3)[:, :, None]
    return at_zero * 10.0 ** (-better - 1.2 * np.linspace(0, 1, scale.NUM_RANKS))


def test_known_tables_are_found_again():
    """Told apart too: what is wrong anywhere, and what is because a place is contradicted."""
    found = bench.fit([drawn(seed, known()) for seed in range(6)])
    assert (np.diff(found) <= 1e-12).all() and found.min() >= 0
    inside = slice(10, -10)
    log, true = np.log10(found[..., inside]), np.log10(known()[..., inside])
    np.testing.assert_allclose(log, true, atol=0.25)
    assert (np.abs((log - true).mean(axis=2)) < 0.05).all()


def test_every_map_counts_alike():
    """A map of ten times the pixels, none of them wrong, counts like a small one."""
    small = drawn(1, known())
    nothing = bench.WrongPixels(*(column[:0] for column in small.wrong))
    large = small._replace(compared=10 * small.compared, wrong=nothing)
    half = bench.fit([small, large])
    np.testing.assert_allclose(half[..., 20:-20].mean(), known()[..., 20:-20].mean() / 2, rtol=0.1)


def test_where_nothing_is_wrong_nothing_is_expected():
    none = bench.WrongPixels(*(column[:0] for column in drawn(1, known()).wrong))
    assert not bench.fit([drawn(1, known())._replace(wrong=none)]).any()


def test_knots_say_the_whole_table():
    shares = bench.fit([drawn(3, known())])
    knots = {
        group: {cause: bench._knots(row) for cause, row in zip(scale.CAUSES, rows, strict=True)}
        for group, rows in zip(scale.GROUPS, shares, strict=True)
    }
    assert max(len(k) for by_cause in knots.values() for k in by_cause.values()) < scale.NUM_RANKS
    np.testing.assert_allclose(scale.tables_of({"tables": knots}), shares, rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize("better", [0.0, 0.5])
def test_reliability_is_that_of_the_maps_pixels(better):
    steps = bench._reliability([drawn(5, known(better))], known())
    total = sum(step["num_compared"] for step in steps)
    assert total == pytest.approx(NUM_DRAWN, rel=0.01)
    expected, found = (
        sum(s[n] * s["num_compared"] for s in steps) for n in ("expected", "outliers")
    )
    assert found == pytest.approx(expected * 10**-better, rel=0.05)


def test_recordings_and_keys_of_the_command_line():
    assert recording_keys("street?seed=5@60,80") == ("street?seed=5", [60, 80])
    assert recording_keys("a@b/drive@101:126:10") == ("a@b/drive", [101, 111, 121])
    for text in ("street", "street@", "@5", "street@all", "street@9:3", "street@5,x"):
        with pytest.raises(argparse.ArgumentTypeError, match=r"a recording and frames|A < B"):
            recording_keys(text)


def test_fits_and_checks_by_the_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "table.json"
    street = "street:static?sensor=vlp16&cameras=rolling"
    arguments = ["--fit", f"{street}@50", "--check", f"{street}&seed=5@30", "--window", "1"]
    chosen = ["--config", "fast", "--camera", "rolling", "--out", str(out)]
    assert main(["bench", "confidence", *arguments, *chosen]) == 0
    written, shown = json.loads(out.read_text()), capsys.readouterr().out
    assert [m["camera"] for m in written["maps"]] == ["rolling"]
    own = scale.tables_of(written)
    assert (np.diff(own) <= 1e-9).all() and own.min() >= 0
    sources = list(written["reliability"])
    assert sources[:2] == ["fitted", "unseen"]
    assert [s.rpartition(", ")[2] for s in sources[2:]] == ["truth", "key held out"]
    for name, steps in written["reliability"].items():
        assert f"{name}: holds for" in shown
        assert sum(step["num_compared"] for step in steps) > 1000
    steps = written["reliability"]["fitted"]
    expected, found = (
        sum(s[n] * s["num_compared"] for s in steps) for n in ("expected", "outliers")
    )
    assert expected == pytest.approx(found, rel=0.3, abs=20)


def test_shipped_tables_are_checked_as_maps_have_them(capsys: pytest.CaptureFixture[str]):
    from densify.bench.depth import bench_depth
    from densify.config import resolve
    from tests.small_street import KEY, one_car

    sequence, config = one_car(), resolve(None)
    measured = bench.bench_confidence([], [(sequence, [KEY])], 2, config)
    assert measured["tables"] == scale.own_file()["tables"]
    assert "fitted" not in measured["reliability"]
    of_maps = bench_depth(sequence, [KEY], 2, {"own": config})["variants"]["own"]["reliability"]
    for source, mine in (("truth", "unseen"), ("key held out", f"{sequence.name}, key held out")):
        steps, theirs = measured["reliability"][mine], of_maps[source]
        assert sum(s["num_compared"] for s in steps) == sum(s["num_compared"] for s in theirs) > 100
        for name, within in (("expected", 0.05), ("outliers", 1e-9)):
            wrong, same = (sum(s[name] * s["num_compared"] for s in r) for r in (steps, theirs))
            assert wrong == pytest.approx(same, rel=within)
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "confidence", "--shipped", "--fit", "street@30"])
    assert "not allowed with argument --shipped" in capsys.readouterr().err


def test_without_truth_there_is_nothing_to_fit(capsys: pytest.CaptureFixture[str]):
    from densify.config import resolve
    from densify.config.errors import InputError
    from tests.small_street import KEY, one_car

    sequence = one_car()
    sequence.truth = None
    with pytest.raises(InputError, match=r"--fit .*: no exact truth"):
        bench.bench_confidence([(sequence, [KEY])], [], 1, resolve(None))
