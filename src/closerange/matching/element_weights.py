"""Which structuring element speaks for which point: weights from the images alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from closerange.features.edge_chains import chain_window
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
    """Return the mean misfit of the point's chain, so many points to each side, shape (M,)."""
    window = chain_window(first.after, first.before, reach)
    there = (window >= 0)[candidates.point]
    column = table.column(candidates.xyz_mm[:, table.axis])
    misfit = np.where(there, table.misfit[window[candidates.point], column[:, None]], 0.0)
    total = np.asarray(misfit.sum(axis=1) / there.sum(axis=1), dtype=np.float64)
    return np.where(column >= 0, total, MISFIT_LIMIT_PX)


def _margin(cost: FloatArray, candidates: Candidates, axis: int) -> FloatArray:
    """Return, for each candidate's point, how much worse the best answer elsewhere is."""
    point = candidates.point
    best = best_rows(cost, point)
    place = np.cumsum(np.r_[True, np.diff(point) > 0]) - 1  # points are in ascending order
    apart = candidates.xyz_mm[:, axis] - candidates.xyz_mm[best, axis][place]
    elsewhere = np.abs(apart) * candidates.px_per_mm > ELSEWHERE_PX
    margin = np.full(len(best), MISFIT_LIMIT_PX)
    np.minimum.at(margin, place[elsewhere], (cost - cost[best][place])[elsewhere])
    return margin[place]


def best_rows(cost: FloatArray, point: IntArray) -> IntArray:
    """Return the row of the least cost of each point that has a row, points ascending."""
    order = np.lexsort((cost, point))
    return order[np.r_[True, np.diff(point[order]) > 0]]
