"""Where an edge point may lie in the other view: its epipolar curve meets chains of edges there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from closerange.features.edge_chains import chain_places
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.pencil import Pencil

SHALLOWEST = 1e-3
"""Sine of the angle between edge and epipolar curve below which nothing can be told."""

PAIRS_AT_ONCE = 200_000
"""Pairs of a point and a piece of chain that are looked at at once: 2 MB for each number."""

ROWS_AT_ONCE = 16_000
"""Candidates that are described at once. Of more, the products with small matrices are shared out
between processors, which takes longer than the products where others work too."""

SLACK = 1e-9
"""Relative width by which the range of slopes is larger than the volume: rounding, far exceeded."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Crossings of epipolar curves with chains of edges in the second view; M rows, by point.

    Attributes
    ----------
    point : ndarray of int, shape (M,)
        Edge point of the first view, ascending.
    link : ndarray of int, shape (M,)
        Edge point of the second view at which the crossed piece of chain begins.
    share : ndarray, shape (M,)
        Place of the crossing between that point (0) and the next (1).
    xy_px : ndarray, shape (M, 2)
        Place of the crossing in the second view.
    xyz_mm : ndarray, shape (M, 3)
        World point on the ray of the edge point.
    tangent : ndarray, shape (M, 2)
        Unit vector along the crossed chain.
    epipolar : ndarray, shape (M, 2)
        Unit vector along the epipolar curve in the second view, away from the first camera.
    sine : ndarray, shape (M,)
        Of the angle between the two.
    px_per_mm : ndarray, shape (M,)
        Way in the second view per way of the world point along the sweep axis, on the ray.
    level : ndarray, shape (M, 2, 2)
        Columns of the mapping of a small step in the first view into the second, both on the
        plane through the world point across the sweep axis.
    upright_first, upright_second : ndarray, shape (M, 2)
        Images of a step of 1 mm along the sweep axis in both views.
    chain, place : ndarray, shape (M,)
        Chain of the second view and place on it.
    """

    point: IntArray
    link: IntArray
    share: FloatArray
    xy_px: FloatArray
    xyz_mm: FloatArray
    tangent: FloatArray
    epipolar: FloatArray
    sine: FloatArray
    px_per_mm: FloatArray
    level: FloatArray
    upright_first: FloatArray
    upright_second: FloatArray
    chain: IntArray
    place: FloatArray

    def __len__(self) -> int:
        return len(self.point)

    def select(self, rows: ArrayLike) -> Candidates:
        """Keep or reorder rows."""
        chosen = np.asarray(rows)
        # [] has a float's type
        kept = np.arange(len(self))[chosen if chosen.size else slice(0)]
        return Candidates(*(getattr(self, item.name)[kept] for item in fields(self)))


def sweep_axis(pencil: Pencil) -> int:
    """Return the world axis (0, 1, 2) along which both cameras look most nearly."""
    forward = (
        pencil.first.camera_from_world.rotation[2] + pencil.second.camera_from_world.rotation[2]
    )
    return int(np.argmax(np.abs(forward)))


def find_candidates(
    pencil: Pencil, first: EdgePoints, second: EdgePoints, volume_mm: FloatArray
) -> Candidates:
    """Intersect the epipolar curve of every edge point with the chains of the other view.

    A crossing counts only if dark and bright lie on the same sides, seen along the epipolar
    curve, and if the world point lies in the measuring volume.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    first, second : EdgePoints
        Edges of both views.
    volume_mm : ndarray, shape (2, 3)
        Lower and upper corner; infinite where there is no limit.

    Returns
    -------
    Candidates
        Sorted by point of the first view.
    """
    theta, slope = pencil.coordinates(pencil.first, first.xy_px)
    point, link, share, met = _crossings(pencil, (theta, slope), (first, second), volume_mm)
    track = chain_places(second.after)
    table = _table(len(point))
    filled = 0
    for start in range(0, len(point), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        xyz_mm = pencil.point(theta[point[rows]], slope[point[rows]], met[rows])
        with np.errstate(invalid="ignore"):
            inside = ((xyz_mm >= volume_mm[0]) & (xyz_mm <= volume_mm[1])).all(axis=1)
        kept = start + np.flatnonzero(inside)
        crossing = (point[kept], link[kept], share[kept])
        part = _described(pencil, second, track, crossing, xyz_mm[inside])
        for item in fields(Candidates):
            getattr(table, item.name)[filled : filled + len(part)] = getattr(part, item.name)
        filled += len(part)
    return Candidates(*(getattr(table, item.name)[:filled] for item in fields(Candidates)))


def _table(count: int) -> Candidates:
    """Return so many rows to be filled in; what is only looked at closely once in short numbers."""

    def numbers(*shape: int) -> FloatArray:
        return np.empty((count, *shape))

    def short(*shape: int) -> FloatArray:
        return np.empty((count, *shape), dtype=np.float32)

    return Candidates(
        point=np.empty(count, np.int64),
        link=np.empty(count, np.int64),
        share=numbers(),
        xy_px=short(2),
        xyz_mm=numbers(3),
        tangent=short(2),
        epipolar=short(2),
        sine=numbers(),
        px_per_mm=numbers(),
        level=short(2, 2),
        upright_first=short(2),
        upright_second=short(2),
        chain=np.empty(count, np.int64),
        place=numbers(),
    )


def _crossings(
    pencil: Pencil,
    rays: tuple[FloatArray, FloatArray],
    edges: tuple[EdgePoints, EdgePoints],
    volume_mm: FloatArray,
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Return point, piece of chain, share of it and slope of the crossings in the volume."""
    first, second = edges
    theta, slope = rays
    lowest, highest = slopes_within(pencil, theta, slope, volume_mm)
    theta_2, slope_2 = pencil.coordinates(pencil.second, second.xy_px)
    rise = np.sign(np.where(lowest <= highest, rise_along(theta, first), 0.0))
    none = np.zeros(0, np.int64)
    found: list[tuple[IntArray, IntArray, FloatArray, FloatArray]] = [
        (none, none, np.zeros(0), np.zeros(0))
    ]
    for point, piece, share, met in crossed_chains((theta, rise), second, (theta_2, slope_2)):
        rows = np.flatnonzero((met >= lowest[point]) & (met <= highest[point]))
        found.append((point[rows], piece[rows], share[rows], met[rows]))
    point, piece, share, met = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((met, point))
    return point[order], piece[order], share[order], met[order]


def crossed_chains(
    curves: tuple[FloatArray, FloatArray],
    edges: EdgePoints,
    coordinates: tuple[FloatArray, FloatArray],
) -> Iterator[tuple[IntArray, IntArray, FloatArray, FloatArray]]:
    """Yield where epipolar curves meet pieces of chains that rise as they do, some at a time.

    Parameters
    ----------
    curves : tuple of two ndarrays, shape (N,)
        Theta of each curve, and the sign with which theta shall change along a chain; with 0 the
        curve meets nothing.
    edges : EdgePoints
        The chains.
    coordinates : tuple of two ndarrays
        Theta and slope of their points.

    Yields
    ------
    curve, piece : ndarray of int, shape (M,)
        Which curve, and the point at which the crossed piece begins.
    share, met : ndarray, shape (M,)
        Place between that point (0) and the next (1), and slope there.
    """
    (theta, rise), (along, slope) = curves, coordinates
    link = np.flatnonzero(edges.after >= 0)
    climb = along[edges.after[link]] - along[link]
    for sign in (1, -1):
        points = np.flatnonzero(rise == sign)
        points = points[np.argsort(theta[points], kind="stable")]
        pieces = link[np.sign(climb) == sign]
        after = edges.after[pieces]
        ends = (along[pieces], along[after])[::sign]
        for nearby, crossed in _straddled(theta[points], *ends):
            point, piece, end = points[nearby], pieces[crossed], after[crossed]
            share = (theta[point] - along[piece]) / (along[end] - along[piece])
            yield point, piece, share, slope[piece] + share * (slope[end] - slope[piece])


def slopes_within(
    pencil: Pencil, theta: FloatArray, slope: FloatArray, volume_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the least and largest slope of rays of the second camera that meet in the volume.

    The first camera's ray is clipped to the box, as its way across the line between the cameras.
    """
    nearest, furthest = np.zeros_like(theta), np.full_like(theta, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(3):
            along, across, upwards = pencil.axes[:, axis]
            pace = slope * along + np.cos(theta) * across + np.sin(theta) * upwards
            ends = (volume_mm[:, axis] - pencil.first.centre_mm[axis])[:, None] / pace
            # NaN is a ray along a wall, which sets no limit
            nearest = np.fmax(nearest, ends.min(axis=0))
            furthest = np.fmin(furthest, ends.max(axis=0))
        lowest = slope - pencil.baseline_mm * (1 + SLACK) / nearest
        return lowest, slope - pencil.baseline_mm * (1 - SLACK) / furthest


def _straddled(
    ordered: FloatArray, low: FloatArray, high: FloatArray
) -> Iterator[tuple[IntArray, IntArray]]:
    """Yield all pairs (i, j) with low[j] <= ordered[i] < high[j], some at a time."""
    start = np.searchsorted(ordered, low, side="left")
    count = np.searchsorted(ordered, high, side="left") - start
    block = np.cumsum(count) // PAIRS_AT_ONCE
    for some in np.split(np.arange(len(low)), np.flatnonzero(np.diff(block)) + 1):
        number = count[some]
        piece = np.repeat(some, number)
        offset = np.arange(len(piece)) - np.repeat(np.cumsum(number) - number, number)
        yield start[piece] + offset, piece


def rise_along(theta: FloatArray, edges: EdgePoints) -> FloatArray:
    """Return the change of theta along the chain through each point."""
    ahead = np.where(edges.after >= 0, theta[edges.after] - theta, 0.0)
    behind = np.where(edges.before >= 0, theta - theta[edges.before], 0.0)
    return np.asarray(ahead + behind)


def _described(
    pencil: Pencil,
    second: EdgePoints,
    track: tuple[IntArray, IntArray],
    crossing: tuple[IntArray, IntArray, FloatArray],
    xyz_mm: FloatArray,
) -> Candidates:
    """Return all there is to say about crossings; `track` has the chains of the second view."""
    point, link, share = crossing
    axis = sweep_axis(pencil)
    across = [other for other in range(3) if other != axis]
    by_first = pencil.first.project_jacobian(xyz_mm)
    by_second = pencil.second.project_jacobian(xyz_mm)
    ray = xyz_mm - pencil.first.centre_mm
    moved = np.einsum("nij,nj->ni", by_second, ray / ray[:, axis, None])
    px_per_mm = np.linalg.norm(moved, axis=1)
    step = second.xy_px[second.after[link]] - second.xy_px[link]
    tangent = step / np.linalg.norm(step, axis=1, keepdims=True)
    epipolar = moved / px_per_mm[:, None]
    sine = np.abs(epipolar[:, 0] * tangent[:, 1] - epipolar[:, 1] * tangent[:, 0])
    return Candidates(
        point=point,
        link=link,
        share=share,
        xy_px=second.xy_px[link] + share[:, None] * step,
        xyz_mm=xyz_mm,
        tangent=tangent,
        epipolar=epipolar,
        sine=np.maximum(sine, SHALLOWEST),
        px_per_mm=px_per_mm,
        level=by_second[:, :, across] @ _inverse(by_first[:, :, across]),
        upright_first=by_first[:, :, axis],
        upright_second=by_second[:, :, axis],
        chain=track[0][link],
        place=track[1][link] + share,
    )


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert 2 x 2 matrices; not finite where the plane is seen edge-on."""
    (a, b), (c, d) = (matrix[:, 0, 0], matrix[:, 0, 1]), (matrix[:, 1, 0], matrix[:, 1, 1])
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse: FloatArray = adjugate / (a * d - b * c)[:, None, None]
    return inverse
