"""Edges that climb: a structuring element that is carried by the edge, not by a plane.

The thesis carries an element into the other view through a plane of constant depth, and so do the
squares and strips of `closerange.matching.depth_table`. Along a slanted edge nothing is at the
depth of its middle. The element here is the strip of the point's own chain, and where it should
be found is the chain of the candidate: the further the two run side by side, the better.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.candidates import Candidates
from closerange.matching.continuity import NEIGHBOUR_PLACES
from closerange.matching.depth_table import MISFIT_LIMIT_PX, Line

GAP = 2
"""Steps along a chain after which a run may go on: one point may lack its candidate."""

LEVEL_PX = 2 * MISFIT_LIMIT_PX
"""A run whose heights differ by less is level enough for elements of constant depth: from its
middle no point is further away than the limit of misfit."""


def slanted_misfit(
    first: EdgePoints, candidates: Candidates, line: Line, axis: int, reach: int
) -> FloatArray:
    """Return the mean misfit of the strip around each point if it climbs with its edge, shape (M,).

    Parameters
    ----------
    first : EdgePoints
        Edges of the first view.
    candidates : Candidates
        M rows, points ascending.
    line : Line
        The edge points, chain after chain.
    axis : int
        World axis along which heights are counted.
    reach : int
        Points of the strip to each side.

    Returns
    -------
    ndarray, shape (M,)
        The limit of misfit times the share of the strip that does not run beside the candidate's
        chain; infinite where the run is level, see `LEVEL_PX`.
    """
    run = runs(first.after, candidates)
    place = line.rank[candidates.point]
    low, high = _extent(run, place)
    start = np.maximum(place - reach, line.start[candidates.point])
    stop = np.minimum(place + reach, line.stop[candidates.point] - 1)
    beside = np.minimum(high[run], stop) - np.maximum(low[run], start) + 1
    misfit = MISFIT_LIMIT_PX * (1.0 - beside / (stop - start + 1))
    least, most = _extent(run, candidates.xyz_mm[:, axis])
    climb_px = (most - least)[run] * candidates.px_per_mm
    return np.where(climb_px > LEVEL_PX, misfit, np.inf)


def runs(after: IntArray, candidates: Candidates) -> IntArray:
    """Return the number of the run of each candidate, from 0, shape (M,).

    Candidates of neighbouring points of a chain are of one run if they are neighbours on a chain
    of the second view too.

    Parameters
    ----------
    after : ndarray of int, shape (N,)
        The next point of each edge point of the first view, or -1.
    candidates : Candidates
        M rows, at least one.
    """
    chains = int(candidates.chain.max()) + 1
    # candidates of one point on one chain stand together, by place
    owners, owner = np.unique(candidates.point * chains + candidates.chain, return_inverse=True)
    span = float(candidates.place.max()) + 2 * GAP * NEIGHBOUR_PLACES + 1.0
    key = owner * span + candidates.place
    order = np.argsort(key, kind="stable")
    keys = key[order]
    following, alone = candidates.point, np.ones(len(candidates), dtype=bool)
    links = []
    for step in range(1, GAP + 1):
        following = np.where(following >= 0, after[following], -1)
        wanted = following * chains + candidates.chain
        group = np.minimum(np.searchsorted(owners, wanted), len(owners) - 1)
        place = group * span + candidates.place + step
        right = np.minimum(np.searchsorted(keys, place), len(keys) - 1)
        left = np.maximum(right - 1, 0)
        near = np.where(np.abs(keys[left] - place) <= np.abs(keys[right] - place), left, right)
        found = alone & (following >= 0) & (owners[group] == wanted)
        found &= np.abs(keys[near] - place) <= NEIGHBOUR_PLACES * step
        links.append(np.stack([np.flatnonzero(found), order[near[found]]]))
        alone &= ~found
    start, stop = np.concatenate(links, axis=1)
    shape = (len(candidates), len(candidates))
    graph = coo_matrix((np.ones(len(start), dtype=np.int8), (start, stop)), shape=shape)
    number: IntArray = connected_components(graph, directed=False)[1].astype(np.int64)
    return number


def _extent(run: IntArray, value: FloatArray | IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the least and the greatest value of each run."""
    order = np.argsort(run, kind="stable")
    start = np.flatnonzero(np.diff(run[order], prepend=-1))
    ordered = np.asarray(value, dtype=np.float64)[order]
    return np.minimum.reduceat(ordered, start), np.maximum.reduceat(ordered, start)
