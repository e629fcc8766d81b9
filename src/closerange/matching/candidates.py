"""Where an edge point may lie in the other view: its epipolar curve meets chains of edges there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from closerange.features.edge_chains import chain_places
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.pencil import Pencil

SHALLOWEST = 1e-3
"""Sine of the angle between edge and epipolar curve below which nothing can be told."""


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
    theta_2, slope_2 = pencil.coordinates(pencil.second, second.xy_px)
    link = np.flatnonzero(second.after >= 0)
    start, stop = theta_2[link], theta_2[second.after[link]]
    point, crossed = _straddled(theta, np.minimum(start, stop), np.maximum(start, stop))
    rising = np.sign(_rise(theta, first))[point] == np.sign(stop - start)[crossed]
    point, crossed = point[rising], crossed[rising]
    link = link[crossed]
    share = (theta[point] - theta_2[link]) / (stop - start)[crossed]
    after = second.after[link]
    met = slope_2[link] + share * (slope_2[after] - slope_2[link])
    xyz_mm = pencil.point(theta[point], slope[point], met)
    with np.errstate(invalid="ignore"):
        inside = ((xyz_mm >= volume_mm[0]) & (xyz_mm <= volume_mm[1])).all(axis=1)
    rows = np.flatnonzero(inside)
    rows = rows[np.lexsort((met[rows], point[rows]))]
    return _described(pencil, second, point[rows], link[rows], share[rows], xyz_mm[rows])


def _straddled(value: FloatArray, low: FloatArray, high: FloatArray) -> tuple[IntArray, IntArray]:
    """Return all pairs (i, j) with low[j] <= value[i] < high[j]."""
    order = np.argsort(value, kind="stable")
    ordered = value[order]
    start = np.searchsorted(ordered, low, side="left")
    count = np.searchsorted(ordered, high, side="left") - start
    piece = np.repeat(np.arange(len(low)), count)
    offset = np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count)
    return order[np.repeat(start, count) + offset], piece


def _rise(theta: FloatArray, edges: EdgePoints) -> FloatArray:
    """Return the change of theta along the chain through each point."""
    ahead = np.where(edges.after >= 0, theta[edges.after] - theta, 0.0)
    behind = np.where(edges.before >= 0, theta - theta[edges.before], 0.0)
    return np.asarray(ahead + behind)


def _described(  # the eight are one row of the table
    pencil: Pencil,
    second: EdgePoints,
    point: IntArray,
    link: IntArray,
    share: FloatArray,
    xyz_mm: FloatArray,
) -> Candidates:
    axis = sweep_axis(pencil)
    across = [other for other in range(3) if other != axis]
    by_first = pencil.first.project_jacobian(xyz_mm)
    by_second = pencil.second.project_jacobian(xyz_mm)
    ray = xyz_mm - pencil.first.centre_mm
    moved = np.einsum("nij,nj->ni", by_second, ray / ray[:, axis, None])
    px_per_mm = np.linalg.norm(moved, axis=1)
    after = second.after[link]
    step = second.xy_px[after] - second.xy_px[link]
    tangent = step / np.linalg.norm(step, axis=1, keepdims=True)
    epipolar = moved / px_per_mm[:, None]
    sine = np.abs(epipolar[:, 0] * tangent[:, 1] - epipolar[:, 1] * tangent[:, 0])
    chain, place = chain_places(second.after)
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
        chain=chain[link],
        place=place[link] + share,
    )


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert 2 x 2 matrices; not finite where the plane is seen edge-on."""
    (a, b), (c, d) = (matrix[:, 0, 0], matrix[:, 0, 1]), (matrix[:, 1, 0], matrix[:, 1, 1])
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse: FloatArray = adjugate / (a * d - b * c)[:, None, None]
    return inverse
