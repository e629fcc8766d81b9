"""Edge points linked to chains: who follows whom, and walks along them."""

from __future__ import annotations

import numpy as np

from closerange.geometry.arrays import FloatArray, IntArray

REACH_PX = 2
"""How far the next point of a chain may be, in pixels: thinning leaves gaps of one."""

SAME_WAY = 0.6
"""Least cosine between the normals of neighbours: chains turn at a corner, but do not return."""

AHEAD = 0.5
"""Least cosine between the tangent and the way to the next point."""


def link_edges(
    xy_px: FloatArray, normal: FloatArray, size_px: tuple[int, int]
) -> tuple[IntArray, IntArray]:
    """Link every point with the best one ahead, where that finds it the best one behind.

    Parameters
    ----------
    xy_px : ndarray, shape (N, 2)
        Edge points.
    normal : ndarray, shape (N, 2)
        Unit vectors towards the brighter side.
    size_px : tuple of int
        Width and height of the image.

    Returns
    -------
    after, before : ndarray of int, shape (N,)
        Row of the next and of the previous point, or -1.
    """
    count = len(xy_px)
    if count == 0:
        return np.full(0, -1, dtype=np.int64), np.full(0, -1, dtype=np.int64)
    first, second = _neighbours(xy_px, size_px)
    (x, y), (across, down) = np.ascontiguousarray(xy_px.T), np.ascontiguousarray(normal.T)
    same = across[first] * across[second] + down[first] * down[second] > SAME_WAY
    first, second = first[same], second[same]
    step_x, step_y = x[second] - x[first], y[second] - y[first]
    distance = np.maximum(np.sqrt(step_x * step_x + step_y * step_y), 1e-9)
    ahead = (step_y * across[first] - step_x * down[first]) / distance
    # both tangents should lie along the way between the two points
    bend = np.abs(step_x * across[first] + step_y * down[first])
    bend += np.abs(step_x * across[second] + step_y * down[second])
    cost = distance + bend
    after = _best(count, np.flatnonzero(ahead > AHEAD), (first, second), cost)
    before = _best(count, np.flatnonzero(ahead < -AHEAD), (first, second), cost)
    mutual = (after >= 0) & (before[after] == np.arange(count))
    after = np.where(mutual, after, -1)
    before = np.full(count, -1, dtype=np.int64)
    before[after[mutual]] = np.flatnonzero(mutual)
    return after, before


def _best(
    count: int, rows: IntArray, pairs: tuple[IntArray, IntArray], cost: FloatArray
) -> IntArray:
    """Return the other point of the cheapest of some pairs of each point, or -1."""
    first, second, price = pairs[0][rows], pairs[1][rows], cost[rows]
    least = np.full(count, np.inf)
    np.minimum.at(least, first, price)
    cheapest = np.flatnonzero(price == least[first])[::-1]
    best = np.full(count, -1, dtype=np.int64)
    best[first[cheapest]] = second[cheapest]  # of equal ones the first, which is written last
    return best


def chain_line(after: IntArray) -> tuple[IntArray, IntArray]:
    """Lay out all points in one row, chain after chain.

    Parameters
    ----------
    after : ndarray of int, shape (N,)
        The next point, or -1; no two have the same.

    Returns
    -------
    order : ndarray of int, shape (N,)
        The points. Open chains come first, by their first points; a closed chain starts at its
        first point in the order of rows.
    end : ndarray of int, shape (C,)
        Where in that order each chain ends.
    """
    count = len(after)
    headless = np.ones(count, dtype=bool)
    headless[after[after >= 0]] = False
    following = after.tolist()
    order: list[int] = []
    end: list[int] = []
    add = order.append
    for start in np.flatnonzero(headless).tolist():
        point = start
        while point >= 0:
            add(point)
            point = following[point]
        end.append(len(order))
    rest = np.ones(count, dtype=bool)
    rest[order] = False
    for start in np.flatnonzero(rest).tolist():
        point = start
        while rest[point]:
            rest[point] = False
            order.append(point)
            point = following[point]
        if not end or end[-1] < len(order):
            end.append(len(order))
    return np.array(order, dtype=np.int64), np.array(end, dtype=np.int64)


def chain_numbers(after: IntArray) -> IntArray:
    """Return the number of each point's chain, from 0; shape (N,)."""
    return chain_places(after)[0]


def chain_places(after: IntArray) -> tuple[IntArray, IntArray]:
    """Return chain and place in it of every point.

    Parameters
    ----------
    after : ndarray of int, shape (N,)
        The next point, or -1.

    Returns
    -------
    chain, place : ndarray of int, shape (N,)
        Number of the chain and number within it, both from 0; a closed chain starts at its
        first point in the order of rows.
    """
    order, end = chain_line(after)
    length = np.diff(end, prepend=0)
    chain, place = np.empty_like(order), np.empty_like(order)
    chain[order] = np.repeat(np.arange(len(end)), length)
    place[order] = np.arange(len(order)) - np.repeat(end - length, length)
    return chain, place


def chain_window(after: IntArray, before: IntArray, reach: int) -> IntArray:
    """Return the points up to so many steps behind and ahead of each, shape (N, 2 reach + 1).

    The middle column is the point itself; -1 where the chain has ended.
    """
    count = len(after)
    window = np.full((count, 2 * reach + 1), -1, dtype=np.int64)
    window[:, reach] = np.arange(count)
    # one row more, for -1 to stay -1
    ahead, behind = np.append(after, -1), np.append(before, -1)
    for step in range(1, reach + 1):
        window[:, reach + step] = ahead[window[:, reach + step - 1]]
        window[:, reach - step] = behind[window[:, reach - step + 1]]
    return window


def _neighbours(xy_px: FloatArray, size_px: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """Return all pairs of points whose pixels are at most `REACH_PX` apart in row and column."""
    width = size_px[0]
    pixel = np.rint(xy_px).astype(np.int64) + REACH_PX + 1
    stride = width + 2 * (REACH_PX + 1)
    place = pixel[:, 1] * stride + pixel[:, 0]
    order = np.argsort(place, kind="stable")
    places = place[order]
    pairs_first, pairs_second = [], []
    for down in range(-REACH_PX, REACH_PX + 1):
        # points of one row of the neighbourhood are neighbours in the sorted list
        middle = places + down * stride
        start = np.searchsorted(places, middle - REACH_PX, side="left")
        stop = np.searchsorted(places, middle + REACH_PX, side="right")
        count = stop - start
        first = np.repeat(np.arange(len(places)), count)
        offset = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
        pairs_first.append(first)
        pairs_second.append(np.repeat(start, count) + offset)
    first, second = np.concatenate(pairs_first), np.concatenate(pairs_second)
    apart = first != second
    return order[first[apart]], order[second[apart]]
