"""Which structuring element speaks for which point: weights from the images alone."""

from __future__ import annotations

import numpy as np

from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.candidates import Candidates
from closerange.matching.depth_table import MISFIT_LIMIT_PX, DepthTable, Element, Square, Strip
from closerange.matching.slanted_edges import slanted_misfit

SQUARES = (0.02, 0.045, 0.094)
"""Half-widths of the square elements per image width, in steps of about two. Of a picture of whole
parts a fiftieth holds one corner or rim, a twentieth the neighbouring edges of a part, a tenth most
of the part: what repeats within it is told apart by what does not. Which steps they are hardly
matters: see `benchmarks/bench_elements.py`."""

STRIPS = (0.0625, 0.25)
"""Half-lengths of the elements that follow the point's own chain, per image width: some of it, and
mostly all. They hold no edge of another part: right for wires and thin parts, where a square sees
mostly what does not fit. The short one stays on one side of a corner."""

SLANT_PRICE = MISFIT_LIMIT_PX * 2 / 3
"""Cost in px of the less usual hypothesis that an edge is slanted: it is preferred to a level
element only where two thirds of the points of that find nothing."""

SQUARES_SHARE = 2 / 3
"""Weight of squares, of a point with one candidate. A chain may run on behind what hides it in the
other view, beside an edge that is seen there; what stands around the point does not agree then."""

ELSEWHERE_PX = 1.5
"""Candidates further apart than this, along the epipolar curve, are different answers."""

POWER = 2
"""Power of the margins that are the weights: of measurements whose signals differ and whose noise
is alike, a mean weighted by the squared signals is the surest. Noise is nearly alike: most of it is
what an element sees of other heights, which more edges do not average out."""


def support(first: EdgePoints, candidates: Candidates, table: DepthTable) -> FloatArray:
    """Return the mean misfit within the elements that suit each point, shape (M,).

    For every point each element has an answer, its best candidate, and a margin: by how much the
    best candidate elsewhere is worse. An element that is too small, or sees only what repeats,
    or sees other heights, has a small margin. Elements are weighted by the square of it. A point
    with one candidate has no margins, and the question is whether it is there at all: see
    `_doubtful`.

    All elements are level, as the thesis' is. Where they fit badly the edge may be slanted: how far
    it runs beside the candidate's chain is the cost then.

    Parameters
    ----------
    first : EdgePoints
        Edges of the first view.
    candidates : Candidates
        M rows.
    table : DepthTable
        Misfit of every edge point at every height.
    """
    costs = np.array(table.means(candidates, _elements(first, table)))
    margins = np.array([_margin(cost, candidates, table.axis) for cost in costs])
    weights = margins**POWER + 1e-6  # none has a margin: all the same
    level = np.einsum("em,em->m", costs, weights / weights.sum(axis=0))
    alone = (margins == MISFIT_LIMIT_PX).all(axis=0)
    level[alone] = _doubtful(costs[:, alone])
    reach = round(max(STRIPS) * first.size_px[0])
    slanted = slanted_misfit(first, candidates, table.line, table.axis, reach)
    return np.asarray(np.minimum(level, slanted + SLANT_PRICE))


def _doubtful(costs: FloatArray) -> FloatArray:
    """Return the cost of only candidates, given that of each element: the worse of two verdicts.

    One gives squares more say. The other leaves out the longest strip: a chain that is hidden here
    may be seen for the most part.
    """
    squares, strips = costs[: len(SQUARES)], costs[len(SQUARES) :]
    around = SQUARES_SHARE * squares.mean(axis=0) + (1 - SQUARES_SHARE) * strips.mean(axis=0)
    return np.asarray(np.maximum(around, costs[:-1].mean(axis=0)))


def _elements(first: EdgePoints, table: DepthTable) -> list[Element]:
    """Return squares and strips, the longest strip last."""
    width = first.size_px[0]
    squares = [Square.of(table.line, first.xy_px, share * width) for share in SQUARES]
    strips = [Strip.of(table.line, round(share * width)) for share in STRIPS]
    return [*squares, *strips]


def _margin(cost: FloatArray, candidates: Candidates, axis: int) -> FloatArray:
    """Return, for each candidate's point, how much worse the best answer elsewhere is."""
    start, place = _groups(candidates.point)
    best = best_rows(cost, candidates.point)
    apart = candidates.xyz_mm[:, axis] - candidates.xyz_mm[best, axis][place]
    elsewhere = np.abs(apart) * candidates.px_per_mm > ELSEWHERE_PX
    worse = np.where(elsewhere, cost - cost[best][place], MISFIT_LIMIT_PX)
    return np.asarray(np.minimum(np.minimum.reduceat(worse, start), MISFIT_LIMIT_PX)[place])


def best_rows(cost: FloatArray, point: IntArray) -> IntArray:
    """Return the row of the least cost of each point that has a row, points ascending."""
    start, place = _groups(point)
    known = np.where(np.isnan(cost), np.inf, cost)
    least = np.flatnonzero(known == np.minimum.reduceat(known, start)[place])
    # of equal ones the first
    return least[np.r_[True, np.diff(place[least]) > 0]]


def _groups(point: IntArray) -> tuple[IntArray, IntArray]:
    """Return the first row of each point, and the number of its point for each row."""
    begins = np.r_[True, point[1:] != point[:-1]]
    return np.flatnonzero(begins), np.cumsum(begins) - 1
