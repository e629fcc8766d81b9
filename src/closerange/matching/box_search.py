"""The best box in a grid of nodes."""

from __future__ import annotations

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray, IntArray

Slices = tuple[slice, slice, slice]


def best_box(inside: BoolArray, worth: FloatArray) -> tuple[Slices, float] | None:
    """Find the box whose nodes are all inside and whose worth is the largest.

    Parameters
    ----------
    inside : ndarray of bool, shape (nx, ny, nz)
        Which nodes may belong to the box.
    worth : ndarray, shape (nx, ny, nz)
        Density at each node, 0 or more; ignored where not inside.

    Returns
    -------
    slices, worth : tuple of slices, float; or None
        Nodes of the box along each axis and the integral of the density from its first to its
        last nodes by the trapezoidal rule, in cells; the first of equals. Where no box has two
        nodes along each axis, the best single node with a worth of 0. None if none is inside.

    Notes
    -----
    Every pair of first and last layer in Z, every pair in X, then the longest runs in Y. Pairs
    whose whole worth is below the best one found so far are passed over.
    """
    if not inside.any():
        return None
    value = np.where(inside, worth, 0.0)
    top = np.unravel_index(int(np.argmax(np.where(inside, worth, -1.0))), inside.shape)
    x, y, z = (slice(int(i), int(i) + 1) for i in top)
    found: Slices = (x, y, z)
    best = 0.0
    first, last = np.triu_indices(inside.shape[0], 1)
    for low in range(inside.shape[2]):
        column = inside[:, :, low].copy()
        weight = value[:, :, low] / 2
        for high in range(low + 1, inside.shape[2]):
            column &= inside[:, :, high]
            weight = weight + value[:, :, high]
            density = np.where(column, weight - value[:, :, high] / 2, 0.0)
            if not column.any():
                break
            if density.sum() <= best:
                continue
            rectangle, most = _best_rectangle(column, density, first, last)
            if most > best * (1 + 1e-12):  # equal but for rounding: the first one stays
                best, found = most, (*rectangle, slice(low, high + 1))
    return found, best


def _best_rectangle(
    column: BoolArray, density: FloatArray, first: IntArray, last: IntArray
) -> tuple[tuple[slice, slice], float]:
    """Find the best rectangle in X and Y among columns that are inside all along Z."""
    counts = np.pad(np.cumsum(column, axis=0), ((1, 0), (0, 0)))
    sums = np.pad(np.cumsum(density, axis=0), ((1, 0), (0, 0)))
    whole: BoolArray = counts[last + 1] - counts[first] == (last - first + 1)[:, None]
    strip = sums[last + 1] - sums[first] - (density[first] + density[last]) / 2
    strip = np.where(whole, strip, 0.0)
    # every run reaches back to the node after the last gap: no worth is negative
    place = np.arange(column.shape[1])
    start = np.maximum.accumulate(np.where(whole, 0, place + 1), axis=1)
    start = np.minimum(start, place)  # a gap itself: an empty run
    total = np.cumsum(strip, axis=1)
    at_start = np.take_along_axis(total, start, axis=1), np.take_along_axis(strip, start, axis=1)
    run = total - at_start[0] + (at_start[1] - strip) / 2
    pair, end = (int(i) for i in np.unravel_index(int(np.argmax(run)), run.shape))
    rows = slice(int(first[pair]), int(last[pair]) + 1)
    return (rows, slice(int(start[pair, end]), end + 1)), float(run[pair, end])
