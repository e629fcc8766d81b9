"""The choice along chains, against all choices tried one by one."""

from __future__ import annotations

from itertools import pairwise, product

import numpy as np
import pytest

from closerange.features.edges import EdgePoints
from closerange.matching import continuity
from closerange.matching.candidates import Candidates
from closerange.matching.continuity import (
    CHANGE,
    MOST_CANDIDATES,
    NEIGHBOUR_PLACES,
    NEIGHBOUR_PRICE,
    NO_MATCH,
    STEP_LIMIT,
    STEP_PRICE,
    choose,
)


def chain_of(lengths):
    """Make edge points on straight chains of so many points."""
    count = sum(lengths)
    after, before = np.full(count, -1), np.full(count, -1)
    start = 0
    for length in lengths:
        after[start : start + length - 1] = np.arange(start + 1, start + length)
        before[start + 1 : start + length] = np.arange(start, start + length - 1)
        start += length
    one = np.ones(count)
    xy = np.column_stack([np.arange(count) + 5.0, np.full(count, 9.0)])
    up = np.tile([0.0, -1.0], (count, 1))
    return EdgePoints(xy, up, one, one, 0.01 * one, 0.0 * one, after, before, (count + 10, 20))


def candidates_of(rng, counts):
    point = np.repeat(np.arange(len(counts)), counts)
    total = len(point)
    zero, two = np.zeros(total), np.zeros((total, 2))
    return Candidates(
        point=point, link=np.zeros(total, int), share=zero, xy_px=two,
        xyz_mm=np.column_stack([zero, zero, rng.uniform(0, 4, total)]), tangent=two, epipolar=two,
        sine=zero + 1, px_per_mm=np.full(total, 2.0), level=np.zeros((total, 2, 2)),
        upright_first=two, upright_second=two, chain=rng.integers(0, 2, total),
        place=rng.uniform(0, 9, total),
    )  # fmt: skip


def step_price(candidates, a, b):
    """Say what two neighbours pay; None stands for no match."""
    if a is None or b is None:
        return 0.0 if a is b else CHANGE
    apart = abs(candidates.xyz_mm[a, 2] - candidates.xyz_mm[b, 2]) * candidates.px_per_mm[a]
    price = min(STEP_PRICE * apart, STEP_LIMIT)
    near = abs(candidates.place[a] - candidates.place[b]) <= NEIGHBOUR_PLACES
    if candidates.chain[a] == candidates.chain[b] and near:
        price = min(price, NEIGHBOUR_PRICE)
    return price


def best_by_enumeration(rows, candidates, cost):
    """Try every choice of a chain; return the least cost with each answer of each point."""
    least = [{} for _ in rows]
    for choice in product(*rows):
        total = sum(NO_MATCH if c is None else cost[c] for c in choice)
        total += sum(step_price(candidates, *pair) for pair in pairwise(choice))
        for place, c in enumerate(choice):
            least[place][c] = min(least[place].get(c, np.inf), total)
    return least


@pytest.mark.parametrize("seed", range(6))
def test_the_choice_is_the_cheapest_of_all(seed):
    rng = np.random.default_rng(seed)
    lengths = (5, 1, 4)
    counts = rng.integers(0, 4, sum(lengths))
    edges, candidates = chain_of(lengths), candidates_of(rng, counts)
    cost = rng.uniform(0, 4, len(candidates))
    chosen = choose(edges, candidates, cost, 2)
    start = 0
    for length in lengths:
        points = range(start, start + length)
        rows = [[*np.flatnonzero(candidates.point == p).tolist(), None] for p in points]
        least = best_by_enumeration(rows, candidates, cost)
        for place, p in enumerate(points):
            answers = {c: v for c, v in least[place].items() if c is not None}
            if not answers:
                assert chosen.candidate[p] == -1
                assert not chosen.matched[p]
                continue
            best = min(answers, key=answers.get)
            assert chosen.candidate[p] == best
            assert chosen.matched[p] == (answers[best] < least[place][None])
            apart = {
                c: abs(candidates.xyz_mm[c, 2] - candidates.xyz_mm[best, 2]) * 2.0 for c in answers
            }
            others = [answers[c] for c in answers if apart[c] > STEP_LIMIT / 2]
            margin = min(others, default=np.inf) - answers[best]
            assert chosen.margin[p] == pytest.approx(margin, abs=1e-4)
            rivals = [cost[c] for c in answers if apart[c] > STEP_LIMIT / 2]
            lead = min(rivals, default=np.inf) - cost[best]
            assert chosen.lead[p] == pytest.approx(lead, abs=1e-4)
            assert chosen.cost[p] == pytest.approx(cost[best], abs=1e-6)
        start += length


def test_blocks_and_crowded_points_make_no_difference(monkeypatch):
    """Twenty chains worked on together and one by one; some points have too many candidates."""
    rng = np.random.default_rng(3)
    lengths = rng.integers(1, 300, 20).tolist()
    counts = rng.integers(0, 4, sum(lengths))
    counts[::50] = MOST_CANDIDATES + 5
    edges, candidates = chain_of(lengths), candidates_of(rng, counts)
    cost = rng.uniform(0, 4, len(candidates))
    whole = choose(edges, candidates, cost, 2)
    monkeypatch.setattr(continuity, "AT_ONCE", 1)
    single = choose(edges, candidates, cost, 2)
    for name in ("candidate", "matched", "margin", "cost", "lead"):
        np.testing.assert_array_equal(getattr(single, name), getattr(whole, name))
    for point in range(0, len(counts), 50):
        rows = np.flatnonzero(candidates.point == point)
        assert (cost[rows] < cost[whole.candidate[point]]).sum() < MOST_CANDIDATES


def test_a_chain_longer_than_a_piece_is_one_chain():
    """A flat line of heights wins over cheaper, jumping ones, over 300 points and all seams."""
    count = 300
    rng = np.random.default_rng(9)
    candidates = candidates_of(rng, np.full(count, 2))
    heights = np.where(np.arange(2 * count) % 2 == 0, 1.0, rng.uniform(0, 40, 2 * count))
    object.__setattr__(candidates, "xyz_mm", np.column_stack([np.zeros((600, 2)), heights]))
    object.__setattr__(candidates, "chain", np.arange(600))
    cost = np.where(np.arange(600) % 2 == 0, 1.0, 0.5)
    chosen = choose(chain_of((count,)), candidates, cost, 2)
    assert (chosen.candidate % 2 == 0).mean() > 0.98
    assert chosen.matched.all()


def test_no_candidates_and_no_points():
    edges = chain_of((4,))
    nothing = candidates_of(np.random.default_rng(0), np.zeros(4, int))
    chosen = choose(edges, nothing, np.zeros(0), 2)
    assert (chosen.candidate == -1).all()
    assert not chosen.matched.any()
    assert np.isnan(chosen.cost).all()
    none = choose(edges.select([]), nothing, np.zeros(0), 2)
    assert len(none.candidate) == 0
