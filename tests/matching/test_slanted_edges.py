"""Runs of an edge beside another, against walks made one by one, and a slanted edge."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from closerange.features.edges import EdgePoints
from closerange.matching.candidates import Candidates
from closerange.matching.depth_table import MISFIT_LIMIT_PX, Line
from closerange.matching.slanted_edges import GAP, LEVEL_PX, NEIGHBOUR_PLACES, runs, slanted_misfit

WIDTHS = {"xy_px": 2, "xyz_mm": 3, "tangent": 2, "epipolar": 2, "upright_first": 2}


def _candidates(point, chain, place, height):
    count = len(point)
    made = {}
    for field in fields(Candidates):
        made[field.name] = np.zeros((count, WIDTHS[field.name]) if field.name in WIDTHS else count)
    made["point"], made["chain"] = np.asarray(point), np.asarray(chain)
    made["place"] = np.asarray(place, dtype=np.float64)
    made["xyz_mm"] = np.column_stack([np.zeros((count, 2)), height])
    made["px_per_mm"] = np.full(count, 2.0)
    made["upright_second"], made["level"] = np.zeros((count, 2)), np.zeros((count, 2, 2))
    return Candidates(**made)


def _chain(length):
    return np.append(np.arange(1, length), -1)


def _edges(after):
    count = len(after)
    before = np.full(count, -1)
    before[after[after >= 0]] = np.flatnonzero(after >= 0)
    made = {}
    for field in fields(EdgePoints):
        made[field.name] = np.ones(count)
    made["xy_px"] = np.column_stack([np.arange(count), np.zeros(count)])
    made["normal"] = np.column_stack([np.zeros(count), np.ones(count)])
    made["after"], made["before"], made["size_px"] = after, before, (400, 100)
    return EdgePoints(**{name: made[name] for name in made})


def _misfit(after, candidates, reach=1000):
    return slanted_misfit(_edges(after), candidates, Line.of(after), 2, reach)


def test_runs_are_those_of_walks_made_one_by_one():
    rng = np.random.default_rng(3)
    after = np.where(rng.random(120) < 0.05, -1, np.append(np.arange(1, 120), -1))
    point = np.sort(rng.integers(0, 120, 300))
    candidates = _candidates(
        point, rng.integers(0, 3, 300), point + rng.normal(0.0, 3.0, 300) + 9, np.zeros(300)
    )
    parent = np.arange(300)

    def root(row):
        while parent[row] != row:
            row = parent[row]
        return row

    for row in range(300):
        following = candidates.point[row]
        for step in range(1, GAP + 1):
            following = after[following] if following >= 0 else -1
            there = np.flatnonzero(
                (candidates.point == following) & (candidates.chain == candidates.chain[row])
            )
            away = np.abs(candidates.place[there] - candidates.place[row] - step)
            if following >= 0 and there.size and away.min() <= NEIGHBOUR_PLACES * step:
                parent[root(row)] = root(there[np.argmin(away)])
                break
    wanted = np.array([root(row) for row in range(300)])
    found = runs(after, candidates)
    assert 20 < len(set(found.tolist())) < 250
    np.testing.assert_array_equal(found[:, None] == found, wanted[:, None] == wanted)


def test_an_edge_that_climbs_beside_one_other_costs_nothing():
    after = _chain(100)
    height = 0.3 * np.arange(100)
    misfit = _misfit(after, _candidates(np.arange(100), np.zeros(100, int), np.arange(100), height))
    np.testing.assert_allclose(misfit, 0.0, atol=1e-12)


def test_a_level_edge_is_left_to_level_elements():
    after, place = _chain(100), np.arange(100)
    climb_mm = LEVEL_PX / 2.0  # two px per mm
    for share, level in ((0.99, True), (1.01, False)):
        height = np.linspace(0.0, share * climb_mm, 100)
        misfit = _misfit(after, _candidates(place, np.zeros(100, int), place, height))
        assert np.isinf(misfit).all() == level


@pytest.mark.parametrize("reach", [1000, 10])
def test_the_cost_is_the_share_that_does_not_run_beside(reach):
    after, place = _chain(100), np.arange(30, 70)
    misfit = _misfit(
        after, _candidates(place, np.zeros(40, int), place, 0.5 * np.arange(40)), reach
    )
    for row, point in enumerate(place):
        strip = np.arange(max(point - reach, 0), min(point + reach, 99) + 1)
        beside = np.isin(strip, place).mean()
        assert misfit[row] == pytest.approx(MISFIT_LIMIT_PX * (1 - beside))


def test_a_run_passes_over_one_gap_and_stops_at_two():
    after, height = _chain(60), 0.5 * np.arange(60)
    for missing, whole in (([30], True), ([30, 31], False)):
        kept = np.setdiff1d(np.arange(60), missing)
        found = runs(after, _candidates(kept, np.zeros(len(kept), int), kept, height[kept]))
        assert (len(set(found.tolist())) == 1) == whole


def test_another_chain_or_a_leap_along_it_is_another_run():
    after, point = _chain(40), np.arange(40)
    half = point // 20
    assert len(set(runs(after, _candidates(point, half, point, point)).tolist())) == 2
    leap = point + 50 * half
    assert len(set(runs(after, _candidates(point, 0 * half, leap, point)).tolist())) == 2


def test_one_candidate():
    misfit = _misfit(_chain(5), _candidates([2], [0], [7.0], [1.0]))
    assert np.isinf(misfit).all()
