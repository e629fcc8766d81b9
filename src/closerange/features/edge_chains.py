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
    follower = [np.full(count, -1, dtype=np.int64) for _ in range(2)]
    if count == 0:
        return follower[0], follower[1]
    tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
    first, second = _neighbours(xy_px, size_px)
    step = xy_px[second] - xy_px[first]
    distance = np.maximum(np.linalg.norm(step, axis=1), 1e-9)
    ahead = _dot(step, tangent[first]) / distance
    # both tangents should lie along the way between the two points
    bend = np.abs(_dot(step, normal[first])) + np.abs(_dot(step, normal[second]))
    cost = distance + bend
    same = (_dot(normal[first], normal[second]) > SAME_WAY) & (np.abs(ahead) > AHEAD)
    for side, mask in enumerate((same & (ahead > 0), same & (ahead < 0))):
        rows = np.flatnonzero(mask)
        rows = rows[np.lexsort((cost[rows], first[rows]))]
        best = rows[np.r_[True, np.diff(first[rows]) > 0]] if rows.size else rows
        follower[side][first[best]] = second[best]
    after, before = follower
    mutual = (after >= 0) & (before[after] == np.arange(count))
    after = np.where(mutual, after, -1)
    before = np.full(count, -1, dtype=np.int64)
    before[after[mutual]] = np.flatnonzero(mutual)
    return after, before


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
    count = len(after)
    chain, place = np.full(count, -1, dtype=np.int64), np.zeros(count, dtype=np.int64)
    following = after.tolist()
    headless = np.ones(count, dtype=bool)
    headless[after[after >= 0]] = False
    starts = [*np.flatnonzero(headless).tolist(), *range(count)]
    number = 0
    names, places = chain.tolist(), place.tolist()
    for start in starts:
        if names[start] >= 0:
            continue
        point, position = start, 0
        while point >= 0 and names[point] < 0:
            names[point], places[point] = number, position
            point, position = following[point], position + 1
        number += 1
    return np.array(names, dtype=np.int64), np.array(places, dtype=np.int64)


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


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    product: FloatArray = np.einsum("ni,ni->n", a, b)
    return product
