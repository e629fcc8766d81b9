"""Which structuring element speaks for which point: weights from the images alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from closerange.features.edge_chains import chain_places
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.candidates import Candidates
from closerange.matching.depth_table import MISFIT_LIMIT_PX, DepthTable

SQUARES = (0.045, 0.094)
"""Half-widths of the square elements per image width. A twentieth of a picture of whole parts
holds the neighbouring edges of a part, a tenth most of the part: what repeats within it is told
apart by what does not. Smaller squares lose on every scene (`benchmarks/bench_structuring.py`)."""

STRIP = 0.0625
"""Half-length of the element that follows the point's own chain, per image width. It holds no edge
of another height: right for wires and thin parts, where a square sees mostly what does not fit."""

COLUMNS = 64
"""Heights that are worked on at once: 100 MB for 200 000 edge points."""

ELSEWHERE_PX = 1.5
"""Candidates further apart than this, along the epipolar curve, are different answers."""


def support(first: EdgePoints, candidates: Candidates, table: DepthTable) -> FloatArray:
    """Return the mean misfit within the elements that suit each point, shape (M,).

    For every point each element has an answer, its best candidate, and a margin: by how much the
    best candidate elsewhere is worse. An element that is too small, or sees only what repeats,
    or sees other heights, has a small margin. Elements are weighted by the square of it.

    Parameters
    ----------
    first : EdgePoints
        Edges of the first view.
    candidates : Candidates
        M rows.
    table : DepthTable
        Misfit of every edge point at every height.
    """
    costs = element_costs(first, candidates, table)
    weights = np.array([_margin(cost, candidates, table.axis) ** 2 for cost in costs])
    weights += 1e-6  # points with one candidate: all the same
    weights /= weights.sum(axis=0)
    return np.asarray(np.einsum("em,em->m", np.array(costs), weights))


def element_costs(
    first: EdgePoints, candidates: Candidates, table: DepthTable
) -> Sequence[FloatArray]:
    """Return the mean misfit within each element: two squares and the strip, shape (M,) each."""
    width = first.size_px[0]
    squares = [table.support(first.xy_px, candidates, share * width) for share in SQUARES]
    return [*squares, chain_misfit(first, candidates, table, round(STRIP * width))]


def chain_misfit(
    first: EdgePoints, candidates: Candidates, table: DepthTable, reach: int
) -> FloatArray:
    """Return the mean misfit of the point's chain, so many points to each side, shape (M,).

    By running sums along the chains, some columns of the table at a time: neither time nor memory
    grows with the length of the element. A closed chain counts as cut at its first point.
    """
    chain, place = chain_places(first.after)
    order = np.lexsort((place, chain))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    left = np.minimum(place, reach)
    right = np.minimum(np.bincount(chain)[chain] - 1 - place, reach)
    low = (rank - left)[candidates.point]
    high = (rank + right)[candidates.point] + 1
    column = table.column(candidates.xyz_mm[:, table.axis])
    mean = np.full(len(candidates), MISFIT_LIMIT_PX)
    summed = np.zeros((len(order) + 1, COLUMNS))
    for start in range(0, table.misfit.shape[1], COLUMNS):
        part = table.misfit[order, start : start + COLUMNS]
        np.cumsum(part, axis=0, dtype=np.float64, out=summed[1:, : part.shape[1]])
        rows = np.flatnonzero((column >= start) & (column < start + COLUMNS))
        here = column[rows] - start
        total = summed[high[rows], here] - summed[low[rows], here]
        mean[rows] = total / (high - low)[rows]
    return mean


def _margin(cost: FloatArray, candidates: Candidates, axis: int) -> FloatArray:
    """Return, for each candidate's point, how much worse the best answer elsewhere is."""
    point = candidates.point
    best = best_rows(cost, point)
    place = np.cumsum(np.r_[True, np.diff(point) > 0]) - 1  # points are in ascending order
    apart = candidates.xyz_mm[:, axis] - candidates.xyz_mm[best, axis][place]
    elsewhere = np.abs(apart) * candidates.px_per_mm > ELSEWHERE_PX
    margin = np.full(len(best), MISFIT_LIMIT_PX)
    np.minimum.at(margin, place[elsewhere], (cost - cost[best][place])[elsewhere])
    return np.asarray(margin[place])


def best_rows(cost: FloatArray, point: IntArray) -> IntArray:
    """Return the row of the least cost of each point that has a row, points ascending."""
    order = np.lexsort((cost, point))
    return order[np.r_[True, np.diff(point[order]) > 0]]
