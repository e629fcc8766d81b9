"""Figural continuity: neighbours on an edge in one view are neighbours on an edge in the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.candidates import Candidates
from closerange.matching.depth_table import Line

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
"""Cost of having no match where nothing better is known: less than the limit of misfit."""

CHANGE = 1.5
"""Cost of passing from matched to not matched along a chain."""

PIECE = 128
"""Points of a chain that are worked on at once."""

WARM_UP = 32
"""Points before and after such a piece from which messages are sent into it. What lies further
away has no say: after a few steps the limited costs have forgotten the start."""

AT_ONCE = 2_000_000
"""Pairs of candidates whose steps are priced at once: 8 MB for each intermediate result."""

FEW = MOST_CANDIDATES // 2
"""Where not everything can be worked on at once, pieces whose points have so few candidates are
kept apart: the cost grows with the square of the candidates, and most points have few."""

NEVER = np.float32(1e6)

NOWHERE = np.float32(1e9)
"""Height, px or places, of what is no candidate: as far as can be from all others."""


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


def choose(
    first: EdgePoints,
    candidates: Candidates,
    cost: FloatArray,
    axis: int,
    no_match: float = NO_MATCH,
) -> Choice:
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
    no_match : float, optional
        Cost of having no match, px of misfit.

    Returns
    -------
    Choice
        One row for each edge point.
    """
    grid = _Grid.of(len(first), candidates, (cost, no_match), axis)
    belief = grid.unary + _messages(first, grid)
    rows = np.arange(len(first))
    best = belief[:, :-1].argmin(axis=1)
    lowest = belief[rows, best]
    # another answer is one that lies elsewhere, not the same place crossed twice
    away = np.abs(grid.height - grid.height[rows, best][:, None]) * grid.px_per_mm
    other = np.where(away > STEP_LIMIT / 2, belief[:, :-1], np.inf).min(axis=1, initial=np.inf)
    other = np.where(other >= NEVER / 2, np.inf, other)
    rival = np.where(away > STEP_LIMIT / 2, grid.unary[:, :-1], np.inf).min(axis=1, initial=np.inf)
    rival = np.where(rival >= NEVER / 2, np.inf, rival)
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
    """Candidates as a table, N by K; the last column of `unary` is no match.

    Heights count from the middle one, `track` is a candidate's place in a row of all chains of the
    other view that keeps chains apart.
    """

    row: NDArray[np.int32]
    unary: NDArray[np.float32]
    height: NDArray[np.float32]
    px_per_mm: NDArray[np.float32]
    track: FloatArray
    filled: IntArray

    @classmethod
    def of(
        cls, count: int, candidates: Candidates, costs: tuple[FloatArray, float], axis: int
    ) -> _Grid:
        cost, no_match = costs
        kept = _cheapest(candidates.point, cost)
        point = candidates.point[kept]
        filled = np.bincount(point, minlength=count)
        rank = np.arange(len(kept)) - np.repeat(np.cumsum(filled) - filled, filled)
        width = max(int(filled.max(initial=0)), 1)
        height = candidates.xyz_mm[kept, axis]
        apart = candidates.place.max(initial=0.0) + NEIGHBOUR_PLACES + 1.0

        def table(values: NDArray[Any], empty: Any, dtype: type) -> NDArray[Any]:
            grid: NDArray[Any] = np.full((count, width), empty, dtype=dtype)
            grid[point, rank] = values
            return grid

        unary = np.full((count, width + 1), NEVER, dtype=np.float32)
        unary[point, rank] = cost[kept]
        unary[:, -1] = no_match
        return cls(
            row=table(kept, -1, np.int32),
            unary=unary,
            height=table(height - (np.median(height) if len(kept) else 0.0), NOWHERE, np.float32),
            px_per_mm=table(candidates.px_per_mm[kept], 1.0, np.float32),
            track=table(candidates.chain[kept] * apart + candidates.place[kept], NOWHERE, float),
            filled=filled,
        )


def _cheapest(point: IntArray, cost: FloatArray) -> IntArray:
    """Return the rows of the cheapest `MOST_CANDIDATES` of each point, in order."""
    number = np.bincount(point)[point] if len(point) else point
    crowded = np.flatnonzero(number > MOST_CANDIDATES)
    if not crowded.size:
        return np.arange(len(point))
    ranked = crowded[np.lexsort((cost[crowded], point[crowded]))]
    names = point[ranked]
    rank = np.arange(len(ranked)) - np.searchsorted(names, names)
    dropped = np.zeros(len(point), dtype=bool)
    dropped[ranked[rank >= MOST_CANDIDATES]] = True
    return np.flatnonzero(~dropped)


def _messages(first: EdgePoints, grid: _Grid) -> NDArray[np.float32]:
    """Return what every point hears from both sides of its chain, shape (N, K + 1)."""
    line = Line.of(first.after)
    heard = np.zeros_like(grid.unary)
    for pieces, width in _Pieces.of(line).blocks(grid.filled[line.order]):
        walk = _Walk.of(pieces, line.order)
        told = walk.messages(grid, width)[:, walk.inner]
        point = walk.point[walk.inner]
        heard[point, :width] = told[:-1].T
        heard[point, -1] = told[-1]
    return heard


@dataclass(frozen=True, slots=True, eq=False)
class _Pieces:
    """Chains cut to overlapping pieces: places on the line of all points.

    A piece goes from `begin` to `end`; messages count from `low` to `high`.
    """

    begin: IntArray
    low: IntArray
    high: IntArray
    end: IntArray

    @classmethod
    def of(cls, line: Line) -> _Pieces:
        """Cut all chains."""
        start, stop = line.start[line.order], line.stop[line.order]
        place = np.arange(len(start)) - start
        low = np.flatnonzero(place % PIECE == 0)
        start, stop = start[low], stop[low]
        high = np.minimum(low + PIECE, stop)
        return cls(np.maximum(low - WARM_UP, start), low, high, np.minimum(high + WARM_UP, stop))

    def blocks(self, filled: IntArray) -> Iterator[tuple[_Pieces, int]]:
        """Yield some at a time, longest first, and the most candidates of their points."""
        if not len(self.begin):
            return
        ends = np.column_stack([self.begin, self.end]).ravel()
        most = np.maximum.reduceat(np.append(filled, 0), ends)[::2]
        length = self.end - self.begin
        work = length * (most + 1) ** 2
        few = (most <= FEW) & (work.sum() > AT_ONCE)
        for group in (few, ~few):
            rows = np.flatnonzero(group)
            if not rows.size:
                continue
            rows = rows[np.argsort(-length[rows], kind="stable")]
            width = max(int(most[rows].max()), 1)
            block = np.cumsum(length[rows]) * (width + 1) ** 2 // AT_ONCE
            for some in np.split(rows, np.flatnonzero(np.diff(block)) + 1):
                yield self._select(some), width

    def _select(self, rows: IntArray) -> _Pieces:
        return _Pieces(self.begin[rows], self.low[rows], self.high[rows], self.end[rows])


@dataclass(frozen=True, slots=True, eq=False)
class _Walk:
    """Pieces in step: the first point of all, the second of all that have one, and so on.

    Attributes
    ----------
    point : ndarray of int, shape (T,)
        Edge points in that order.
    behind : ndarray of int, shape (T - P,)
        Place in that order of the point before each, but for the first of each of P pieces.
    inner : ndarray of int, shape (I,)
        Places in that order whose messages count.
    first : list of int
        Where each step begins; the last is T.
    """

    point: IntArray
    behind: IntArray
    inner: IntArray
    first: list[int]

    @classmethod
    def of(cls, pieces: _Pieces, order: IntArray) -> _Walk:
        """Arrange pieces, longest first."""
        length = pieces.end - pieces.begin
        number = np.searchsorted(-length, -np.arange(length[0]))  # so many are longer
        first = np.cumsum(number) - number
        step = np.repeat(np.arange(len(number)), number)
        piece = np.arange(len(step)) - first[step]
        place = pieces.begin[piece] + step
        inner = (place >= pieces.low[piece]) & (place < pieces.high[piece])
        later = slice(number[0], None)
        behind = first[step[later] - 1] + piece[later]
        return cls(order[place], behind, np.flatnonzero(inner), [*first.tolist(), len(step)])

    def messages(self, grid: _Grid, width: int) -> NDArray[np.float32]:
        """Return the sum of what each point hears from both sides, shape (width + 1, T)."""
        unary = np.empty((width + 1, len(self.point)), dtype=np.float32)
        unary[:-1], unary[-1] = grid.unary[self.point, :width].T, grid.unary[self.point, -1]
        price = self._prices(grid, width)
        ahead, back = np.zeros_like(unary), np.zeros_like(unary)
        single = self.first[1]  # the first points have no link to one before
        steps = list(zip(self.first[:-2], self.first[1:-1], self.first[2:], strict=True))
        for before, here, after in steps:
            links, last = slice(here - single, after - single), before + after - here
            told = unary[:, before:last] + ahead[:, before:last]
            new = (told[:, None, :] + price[:, :, links]).min(axis=0)
            ahead[:, here:after] = new - new.min(axis=0)
        for before, here, after in reversed(steps):
            links, last = slice(here - single, after - single), before + after - here
            told = unary[:, here:after] + back[:, here:after]
            new = (told[None, :, :] + price[:, :, links]).min(axis=1)
            back[:, before:last] = new - new.min(axis=0)
        return np.asarray(ahead + back)

    def _prices(self, grid: _Grid, width: int) -> NDArray[np.float32]:
        """Return what neighbours pay for each pair of candidates, (width + 1, width + 1, T - P)."""
        later = slice(self.first[1], None)
        height, track = (a[self.point, :width].T for a in (grid.height, grid.track))
        per_mm = grid.px_per_mm[self.point, :width].T[:, self.behind] * np.float32(STEP_PRICE)
        here, there = height[:, self.behind], height[:, later]
        before, after = track[:, self.behind], track[:, later]
        full = np.full((width + 1, width + 1, len(self.behind)), CHANGE, dtype=np.float32)
        full[-1, -1] = 0.0
        for row in range(width):
            price = full[row, :-1]
            np.abs(there - here[row], out=price)
            price *= per_mm[row]
            np.minimum(price, np.float32(STEP_LIMIT), out=price)
            near = np.abs(after - before[row]) <= NEIGHBOUR_PLACES
            np.minimum(price, np.float32(NEIGHBOUR_PRICE), out=price, where=near)
        return full
