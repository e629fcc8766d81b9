"""Figural continuity: neighbours on an edge in one view are neighbours on an edge in the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.features.edge_chains import chain_places
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.candidates import Candidates

MOST_CANDIDATES = 12
"""Candidates of a point that are kept, best first: a true one is hardly ever worse than that."""

STEP_PRICE = 1.0
"""Cost per px of a step in height between neighbours of a chain: as much as a px of misfit."""

STEP_LIMIT = 3.0
"""Cost of any larger step: two edges may look like one chain."""

NEIGHBOUR_PRICE = 0.1
"""Cost of any step between neighbours that are neighbours in the other view: the edge climbs."""

NEIGHBOUR_PLACES = 4.0
"""Places on a chain of the other view that still are neighbours: an edge may be seen there up to
four times as long."""

NO_MATCH = 2.5
"""Cost of having no match: less than the limit of misfit, else chance would be preferred."""

CHANGE = 1.5
"""Cost of passing from matched to not matched along a chain."""

PIECE = 128
"""Points of a chain that are worked on at once."""

WARM_UP = 32
"""Points before and after such a piece from which messages are sent into it. What lies further
away has no say: after a few steps the limited costs have forgotten the start."""

AT_ONCE = 20_000
"""Pairs of neighbours whose steps are priced at once: 25 MB for each intermediate result."""

NEVER = np.float32(1e6)


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """What the chains agree upon; N points.

    Attributes
    ----------
    candidate : ndarray of int, shape (N,)
        Row in `Candidates` of the best one; -1 if the point has none.
    matched : ndarray of bool, shape (N,)
        Whether it is better than no match.
    margin : ndarray, shape (N,)
        Cost in px by which the best other height is worse; infinite without another.
    cost : ndarray, shape (N,)
        Unary cost of the best one, px of misfit.
    lead : ndarray, shape (N,)
        Unary cost of the cheapest other height, less that; infinite without another.
    """

    candidate: IntArray
    matched: BoolArray
    margin: FloatArray
    cost: FloatArray
    lead: FloatArray


def choose(first: EdgePoints, candidates: Candidates, cost: FloatArray, axis: int) -> Choice:
    """Choose one candidate for each edge point, or none.

    Exact min-sum belief propagation along the chains of the first view, a Viterbi search in both
    directions (doi:10.1109/TPAMI.1985.4767639 has the idea): each point pays for its candidate,
    each pair of neighbours for the step between theirs.

    Parameters
    ----------
    first : EdgePoints
        Edges of the first view.
    candidates : Candidates
        M rows.
    cost : ndarray, shape (M,)
        Unary cost, px of misfit.
    axis : int
        World axis of heights.

    Returns
    -------
    Choice
        One row for each edge point.
    """
    grid = _Grid.of(len(first), candidates, cost, axis)
    belief = grid.unary + _messages(first, grid)
    rows = np.arange(len(first))
    best = belief[:, :-1].argmin(axis=1)
    lowest = belief[rows, best]
    # another answer is one that lies elsewhere, not the same place crossed twice
    away = np.abs(grid.height - grid.height[rows, best][:, None]) * grid.px_per_mm
    other = np.where(away > STEP_LIMIT / 2, belief[:, :-1], np.inf).min(axis=1, initial=np.inf)
    other = np.where(other >= NEVER / 2, np.inf, other)
    rival = np.where(away > STEP_LIMIT / 2, grid.unary[:, :-1], np.inf).min(axis=1, initial=np.inf)
    chosen = grid.row[rows, best]
    return Choice(
        candidate=chosen,
        matched=(chosen >= 0) & (lowest < belief[:, -1]),
        margin=np.asarray(other - lowest, dtype=np.float64),
        cost=np.where(chosen >= 0, grid.unary[rows, best], np.nan).astype(np.float64),
        lead=np.asarray(rival - grid.unary[rows, best], dtype=np.float64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Candidates as a table, N by K, best first; the last column of `unary` is no match."""

    row: IntArray
    unary: NDArray[np.float32]
    height: FloatArray
    px_per_mm: FloatArray
    chain: IntArray
    place: FloatArray

    @classmethod
    def of(cls, count: int, candidates: Candidates, cost: FloatArray, axis: int) -> _Grid:
        order = np.lexsort((cost, candidates.point))
        point = candidates.point[order]
        rank = np.arange(len(order)) - np.searchsorted(point, point)
        kept = rank < MOST_CANDIDATES
        order, point, rank = order[kept], point[kept], rank[kept]
        width = int(rank.max(initial=0)) + 1

        def table(values: FloatArray | IntArray, empty: float) -> FloatArray:
            grid = np.full((count, width), empty, dtype=np.asarray(values).dtype)
            grid[point, rank] = values[order]
            return grid

        unary = np.full((count, width + 1), NEVER, dtype=np.float32)
        unary[point, rank] = cost[order]
        unary[:, -1] = NO_MATCH
        row = np.full((count, width), -1, dtype=np.int64)
        row[point, rank] = order
        return cls(
            row=row,
            unary=unary,
            height=table(candidates.xyz_mm[:, axis], np.nan),
            px_per_mm=table(candidates.px_per_mm, 1.0),
            chain=table(candidates.chain, -1).astype(np.int64),
            place=table(candidates.place, np.nan),
        )

    def steps(self, point: IntArray, after: IntArray) -> NDArray[np.float32]:
        """Return what neighbours pay for each pair of candidates, shape (L, K + 1, K + 1)."""
        apart = np.abs(self.height[point][:, :, None] - self.height[after][:, None, :])
        price = np.minimum(STEP_PRICE * apart * self.px_per_mm[point][:, :, None], STEP_LIMIT)
        same = self.chain[point][:, :, None] == self.chain[after][:, None, :]
        near = np.abs(self.place[point][:, :, None] - self.place[after][:, None, :])
        price = np.where(
            same & (near <= NEIGHBOUR_PLACES), np.minimum(price, NEIGHBOUR_PRICE), price
        )
        width = self.unary.shape[1]
        full = np.full((len(point), width, width), CHANGE, dtype=np.float32)
        full[:, :-1, :-1] = np.where(np.isnan(price), NEVER, price)
        full[:, -1, -1] = 0.0
        return full


def _messages(first: EdgePoints, grid: _Grid) -> NDArray[np.float32]:
    """Return what every point hears from both sides of its chain, shape (N, K + 1)."""
    link = np.flatnonzero(first.after >= 0)
    price = np.empty((len(link), *[grid.unary.shape[1]] * 2), dtype=np.float32)
    for start in range(0, len(link), AT_ONCE):
        some = link[start : start + AT_ONCE]
        price[start : start + AT_ONCE] = grid.steps(some, first.after[some])
    number = np.full(len(first), -1, dtype=np.int64)
    number[link] = np.arange(len(link))
    layout = _layout(first)
    heard = np.zeros_like(grid.unary)
    for backwards in (False, True):
        _walk(layout[:, ::-1] if backwards else layout, number, price, grid, heard, backwards)
    return heard


def _layout(first: EdgePoints) -> IntArray:
    """Lay chains out as rows of points, cut to overlapping pieces; -1 where there is none."""
    chain, place = chain_places(first.after)
    length = np.bincount(chain, minlength=1)
    longest = int(length.max(initial=0))
    whole = np.full((len(length), longest), -1, dtype=np.int64)
    whole[chain, place] = np.arange(len(chain))
    pieces = []
    for start in range(0, longest, PIECE):
        rows = whole[length > start, max(start - WARM_UP, 0) : start + PIECE + WARM_UP]
        if start < WARM_UP:
            rows = np.pad(rows, ((0, 0), (WARM_UP - start, 0)), constant_values=-1)
        pieces.append(
            np.pad(rows, ((0, 0), (0, PIECE + 2 * WARM_UP - rows.shape[1])), constant_values=-1)
        )
    return np.concatenate(pieces) if pieces else np.zeros((0, PIECE), dtype=np.int64)


def _walk(
    layout: IntArray,
    number: IntArray,
    price: NDArray[np.float32],
    grid: _Grid,
    heard: NDArray[np.float32],
    backwards: bool,
) -> None:
    """Send messages along every row of the layout; add those of its middle part to `heard`."""
    message = np.zeros((len(layout), grid.unary.shape[1]), dtype=np.float32)
    for step in range(1, layout.shape[1]):
        rows = np.flatnonzero((layout[:, step] >= 0) & (layout[:, step - 1] >= 0))
        if not rows.size:
            continue
        here, there = layout[rows, step - 1], layout[rows, step]
        link = number[there] if backwards else number[here]
        told = (grid.unary[here] + message[rows])[:, :, None]
        costs = price[link].transpose(0, 2, 1) if backwards else price[link]
        new = (told + costs).min(axis=1)
        new -= new.min(axis=1, keepdims=True)
        message[rows] = new
        if WARM_UP <= step < WARM_UP + PIECE:
            heard[there] += new
