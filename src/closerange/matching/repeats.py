"""Repeats whose true partner is hidden: matches that only self-similarity can doubt.

Of equal stripes each fits each. Where both partners of a pair are visible their costs decide. But
a stripe whose partner is hidden in the second view, and one there whose partner is hidden in the
first, fit each other at a wrong height, both ways and without a rival. Nothing that was compared
can tell; what tells is that both have a look-alike beside them, at the distance of one repeat, and
that the places where each would have its partner if they were not the same repeat are not seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.features.edge_chains import chain_places
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.candidates import Candidates, crossed_chains, rise_along, slopes_within
from closerange.matching.evidence import SIDE_STEP_PX, grey_beside
from closerange.matching.pencil import Pencil
from closerange.rig.camera import Camera

APART_PX = 2 * SIDE_STEP_PX
"""Look-alikes are at least so far apart: of nearer ones the same grey is read between them."""

ALIKE_RAD = 0.15
"""Angle between repeats of one edge: lines of one direction converge in an image by less, over a
distance of a tenth of that of the camera."""

SAME_WAY_RAD = 2 * ALIKE_RAD
"""Angle up to which an edge where a repeat should be may be that repeat: noise turns both."""

ALIKE_GREY = 0.5
"""Difference of the grey on either side of two repeats, per contrast of the edge: with more it is
as much like the grey of the other side."""

NEAR = 0.25
"""Share of the repeat by which one may lie off its expected place: half-way to where it would be
as near to the middle between two."""

AGREE = 4 / 3
"""Largest ratio of the repeat in one view to that in the other: so the two other heights, of the
point with the next place there and of the match with the next place here, are one height to a
quarter of the repeat, by which either is uncertain."""

EVERY = 3
"""One of so many points of a chain is asked: a stripe has its neighbours along all of it, so that
a third of its points tells as much."""

ENOUGH = 0.25
"""Share of a pair of chains along which repeats must be seen in both views: clutter may hide most
of what is beside a stripe, but what is alike by chance is so along less than a tenth."""

MAJORITY = 0.5
"""Share of those places from which on their doubt holds for the whole pair of chains."""

POINTS_AT_ONCE = 16_000
"""Points that are looked at at once: some 10 MB, with up to ten look-alikes of each."""


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Edges of one view in coordinates of the pencil; N points.

    Attributes
    ----------
    theta, slope : ndarray, shape (N,)
        Pencil coordinates.
    tangent : ndarray, shape (N, 2)
        Unit vectors along the chain.
    beside : ndarray, shape (N, 2)
        Grey on the dark and on the bright side.
    """

    edges: EdgePoints
    theta: FloatArray
    slope: FloatArray
    tangent: FloatArray
    beside: FloatArray

    @classmethod
    def of(cls, pencil: Pencil, camera: Camera, edges: EdgePoints, grey: NDArray[Any]) -> _View:
        """Describe a view."""
        theta, slope = pencil.coordinates(camera, edges.xy_px)
        beside = grey_beside(grey, edges.xy_px, edges.normal)
        return cls(edges, theta, slope, edges.tangent, beside)

    def neighbours(self, places: _Places) -> _Neighbours:
        """Return the edges of the same direction on both sides of places, along their curves."""
        found = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
        curves, coordinates = (places.theta, places.rise), (self.theta, self.slope)
        for point, piece, _, met in crossed_chains(curves, self.edges, coordinates):
            offset = met - places.slope[point]
            rows = np.flatnonzero(np.abs(offset) <= places.reach[point])
            found.append((point[rows], piece[rows], offset[rows]))
        place, piece, offset = (np.concatenate(column) for column in zip(*found, strict=True))
        return self._alike(places, place, piece, offset)

    def _alike(
        self, places: _Places, place: IntArray, piece: IntArray, offset: FloatArray
    ) -> _Neighbours:
        here = places.edge[place]
        apart = self.edges.xy_px[piece] - self.edges.xy_px[here]
        cosine = np.einsum("ni,ni->n", self.tangent[piece], self.tangent[here])
        rows = np.hypot(*apart.T) > APART_PX
        rows &= cosine > np.cos(SAME_WAY_RAD)
        place, piece, offset, cosine = place[rows], piece[rows], offset[rows], cosine[rows]
        here = here[rows]
        differs = np.abs(self.beside[piece] - self.beside[here])
        contrast = np.abs(self.beside[here, 1] - self.beside[here, 0])
        alike = cosine > np.cos(ALIKE_RAD)
        alike &= np.maximum(differs[:, 0], differs[:, 1]) < ALIKE_GREY * contrast
        return _Neighbours(place, offset, alike)


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Places on epipolar curves of one view; K of them.

    `edge` is the edge point there, `rise` the sign of theta along its chain; `reach` is how far
    along the curve, in slopes, others may lie.
    """

    edge: IntArray
    theta: FloatArray
    slope: FloatArray
    rise: FloatArray
    reach: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Neighbours:
    """Edges of the same direction beside places; J of them.

    `offset` is the way from the place, in slopes; `alike` marks repeats.
    """

    place: IntArray
    offset: FloatArray
    alike: BoolArray

    def repeat(self, count: int) -> FloatArray:
        """Return the distance of the nearest repeat of each of so many places, or infinity."""
        nearest = np.full(count, np.inf)
        np.minimum.at(nearest, self.place[self.alike], np.abs(self.offset[self.alike]))
        return nearest

    def any_at(self, offset: FloatArray, width: FloatArray) -> BoolArray:
        """Mark the places that have an edge so far off, give or take a width."""
        hit = np.abs(self.offset - offset[self.place]) < width[self.place]
        marked = np.zeros(len(offset), dtype=bool)
        marked[self.place[hit]] = True
        return marked


def hidden_repeats(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    greys: tuple[NDArray[Any], NDArray[Any]],
    chosen: Candidates,
    relied: BoolArray,
    clear: tuple[BoolArray, BoolArray],
    volume_mm: FloatArray,
) -> BoolArray:
    """Mark matches of repeated edges whose true partners may both be hidden.

    A point p is matched with R, and both have look-alikes at the distance of one repeat. If p
    belonged with the next repeat after R, then R would belong with the one before p, or the other
    way round. If both pairs lie in the volume and neither was ruled out (an edge is seen there,
    and p, or R, clearly prefers its own match), nothing says that p and R are the same repeat.
    Pairs of chains are judged as a whole, by those of their points where repeats are seen: what
    holds for a part of a stripe holds for all of it. The work grows with the edge points; at each
    only the look-alikes within the volume are held, some points at a time.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    edges : tuple of two EdgePoints
        Of both views.
    greys : tuple of two ndarrays, shape (H, W)
        Grey values of both images, float32.
    chosen : Candidates
        The match of each point of the first view that has one, be it relied upon or not.
    relied : ndarray of bool, shape (N,)
        Whether nothing else speaks against the match of each edge point of the first view.
    clear : tuple of two ndarrays of bool, shapes (N,) and (N2,)
        Whether the match of each point of the first view, in the second, and of each of the
        second, back in the first, is clearly better than all others of that point.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume; infinite where there is no limit.

    Returns
    -------
    ndarray of bool, shape (N,)
        The doubtful ones of those relied upon.
    """
    doubtful = np.zeros(len(edges[0]), dtype=bool)
    trusted = relied[chosen.point]
    if not trusted.any():
        return doubtful
    pair, place = _pairs(edges[0], chosen)
    wanted = np.bincount(pair, trusted)[pair] > 0
    rows = np.flatnonzero(wanted & (place % EVERY == 0))
    views = (
        _View.of(pencil, pencil.first, edges[0], greys[0]),
        _View.of(pencil, pencil.second, edges[1], greys[1]),
    )
    repeated, open_ = np.zeros(len(rows), dtype=bool), np.zeros(len(rows), dtype=bool)
    for start in range(0, len(rows), POINTS_AT_ONCE):
        part = slice(start, start + POINTS_AT_ONCE)
        some = chosen.select(rows[part])
        repeated[part], open_[part] = _open(pencil, views, some, clear, volume_mm)
    asked, seen, doubted = (
        np.bincount(pair[rows], weight, minlength=int(pair.max()) + 1)
        for weight in (None, repeated, open_)
    )
    judged = (seen > 0) & (seen >= ENOUGH * asked) & (doubted >= MAJORITY * seen)
    doubtful[chosen.point] = judged[pair] & trusted
    return doubtful


def _open(
    pencil: Pencil,
    views: tuple[_View, _View],
    some: Candidates,
    clear: tuple[BoolArray, BoolArray],
    volume_mm: FloatArray,
) -> tuple[BoolArray, BoolArray]:
    """Mark matches of repeated edges, and those of them that may be off by one repeat."""
    first, second = views
    theta, slope = first.theta[some.point], first.slope[some.point]
    after = second.edges.after[some.link]
    met = second.slope[some.link] + some.share * (second.slope[after] - second.slope[some.link])
    lowest, highest = slopes_within(pencil, theta, slope, volume_mm)
    reach = np.maximum(met - lowest, highest - met) * AGREE * (1 + NEAR)
    rise = np.sign(rise_along(first.theta, first.edges)[some.point])
    here = first.neighbours(_Places(some.point, theta, slope, rise, reach))
    there = second.neighbours(_Places(some.link, theta, met, rise, reach))
    repeat_1, repeat_2 = here.repeat(len(some)), there.repeat(len(some))
    least, most = np.minimum(repeat_1, repeat_2), np.maximum(repeat_1, repeat_2)
    repeated = np.isfinite(most) & (most <= AGREE * least)
    # infinity less infinity is no place to look at
    repeat_1, repeat_2 = np.where(repeated, repeat_1, 0.0), np.where(repeated, repeat_2, 0.0)
    doubted = np.zeros(len(some), dtype=bool)
    for sign in (1, -1):
        may = repeated & _inside(pencil, theta, (slope, met + sign * repeat_2), volume_mm)
        may &= _inside(pencil, theta, (slope - sign * repeat_1, met), volume_mm)
        may &= ~(there.any_at(sign * repeat_2, NEAR * repeat_2) & clear[0][some.point])
        may &= ~(here.any_at(-sign * repeat_1, NEAR * repeat_1) & clear[1][some.link])
        doubted |= may
    return repeated, doubted


def _inside(
    pencil: Pencil, theta: FloatArray, slopes: tuple[FloatArray, FloatArray], volume_mm: FloatArray
) -> BoolArray:
    """Mark rays that meet in the volume."""
    xyz_mm = pencil.point(theta, *slopes)
    with np.errstate(invalid="ignore"):
        return np.asarray(((xyz_mm >= volume_mm[0]) & (xyz_mm <= volume_mm[1])).all(axis=1))


def _pairs(first: EdgePoints, chosen: Candidates) -> tuple[IntArray, IntArray]:
    """Return the number of the pair of chains of each match, and its place on the first of them."""
    chain, place = chain_places(first.after)
    pair = chain[chosen.point] * (int(chosen.chain.max()) + 1) + chosen.chain
    _, number = np.unique(pair, return_inverse=True)
    return number.reshape(-1), place[chosen.point]
