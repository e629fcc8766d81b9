"""What the images say for and against each candidate: a cost in pixels of misfit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from closerange.features.edge_chains import chain_window
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.geometry.interpolation import bilinear
from closerange.matching.candidates import Candidates, sweep_axis
from closerange.matching.depth_table import MISFIT_LIMIT_PX, DepthTable, Line
from closerange.matching.element_weights import best_rows, support
from closerange.matching.pencil import Pencil
from closerange.rig.camera import Camera

TURN_RAD = 0.4
"""Angle between expected and found direction that counts as much as one pixel of misfit: an edge
that is turned so much has left its place by one pixel within three."""

TURN_WEIGHT = 0.3
"""Share of the turn of the candidate itself: its neighbours' turns are already in their misfit."""

UPRIGHT_RAD = 0.15
"""An edge so near to the image of the sweep axis, in both views, may run along it."""

UPRIGHT_PRICE = 0.2
"""Cost in px of the less usual hypothesis that an edge runs along the sweep axis."""

UPRIGHT_REACH = 10
"""Points of the chain on each side that must agree with that hypothesis."""

SIDE_TOLERANCE = 0.3
"""Difference of the grey values beside an edge, per its contrast, that counts as one misfit unit:
a matt surface changes its brightness by less between views 30 degrees apart."""

FAR_WEIGHT = 0.25
"""Weight of the less similar side: behind an edge the views mostly see different things."""

SIDE_LIMIT = 2.0
"""More than so many units say no more: a highlight differs without limit."""

SIDE_STEP_PX = 2.5
"""Distance from the edge, beyond its blur, at which the grey beside it is read."""

LEAST_CONTRAST = 0.06
"""Differences of grey below this share of the image's range are not held against a candidate much:
shading makes as much on one surface."""

OTHER_WEIGHT = 0.5
"""Weight of a further view against the two that are matched."""

HIDDEN_PX = 2.0
"""Misfit in a further view where nothing is near."""

GOOD_PX = 1.0
"""Cost of candidates from which the brightness of the two views is compared: misfit of a pixel."""

LEAST_PAIRS = 40
"""Pairs of grey values without which both cameras are taken to see the same brightness."""

PLACES_AT_ONCE = 50_000
"""Places at which grey values are read at once: 0.4 MB for each number."""

ENOUGH_PIXELS = 250_000
"""Pixels from which the range of an image is taken: its thousandth part then is 250 of them."""


def turn(first: EdgePoints, candidates: Candidates) -> FloatArray:
    """Return the angle between the found direction and that of a level edge, rad, shape (M,)."""
    expected = np.einsum("nij,nj->ni", candidates.level, first.tangent[candidates.point])
    (x, y), (along_x, along_y) = expected.T, candidates.tangent.T
    # by both products: the cosine alone does not tell small angles
    angle = np.arctan2(np.abs(x * along_y - y * along_x), x * along_x + y * along_y)
    return np.asarray(np.nan_to_num(angle, nan=np.pi))


def unary_cost(
    first: EdgePoints,
    candidates: Candidates,
    greys: tuple[NDArray[Any], NDArray[Any]],
    pencil: Pencil,
) -> FloatArray:
    """Return the cost of each candidate, in pixels of misfit, shape (M,).

    Three terms: how well the edges within the structuring elements of the point fit at the
    candidate's height (or, for an edge that may run along the sweep axis, how well its chain fits
    there); how far the edge is turned; how much the grey of the more similar side differs. The
    nearer surface is on one side only, hence the better side is what counts.

    Parameters
    ----------
    first : EdgePoints
        Edges of the first view.
    candidates : Candidates
        Their crossings in the second view.
    greys : tuple of two ndarrays, shape (H, W)
        Grey values of both images, float32; gain and offset between them may be anything.
    pencil : Pencil
        Of the two cameras.

    Returns
    -------
    ndarray, shape (M,)
        Small is good.
    """
    if not len(candidates):
        return np.zeros(0)
    cost = _misfit(first, candidates, pencil)
    return np.asarray(cost + side_cost(first, candidates, greys, cost))


def reward(candidates: Candidates, others: Sequence[tuple[Camera, EdgePoints]]) -> FloatArray:
    """Return what further views take off the cost of each candidate, px of misfit, shape (M,).

    A reward, not a price: what a further view does not show may be hidden there.

    Parameters
    ----------
    candidates : Candidates
        M rows.
    others : sequence of (Camera, EdgePoints)
        Further views: a candidate's world point should lie on an edge there too.
    """
    earned = np.zeros(len(candidates))
    for camera, edges in others if len(candidates) else ():
        earned += OTHER_WEIGHT * (HIDDEN_PX - _other_view(camera, edges, candidates))
    return earned


def _misfit(first: EdgePoints, candidates: Candidates, pencil: Pencil) -> FloatArray:
    """Return the cost without grey values and without further views, shape (M,)."""
    axis = sweep_axis(pencil)
    origin_mm = float(pencil.first.centre_mm[axis])
    line = Line.of(first.after)
    turned = np.clip(turn(first, candidates) / TURN_RAD, 0.0, MISFIT_LIMIT_PX)
    table = DepthTable.of(line, candidates, turned, axis, origin_mm)
    cost = support(first, candidates, table) + TURN_WEIGHT * turned
    upright, slope = _upright(first, candidates)
    if upright.any():
        rows = candidates.select(upright)
        climbing = DepthTable.of(line, rows, np.zeros(len(rows)), axis, origin_mm)
        chain = _chain_misfit(first, rows, slope[upright], climbing)
        cost[upright] = np.minimum(cost[upright], chain + UPRIGHT_PRICE)
    return np.asarray(cost)


def _other_view(camera: Camera, edges: EdgePoints, candidates: Candidates) -> FloatArray:
    """Return the distance in px from the world point to the nearest edge of a further view."""
    seen = camera.project(candidates.xyz_mm)
    inside = np.isfinite(seen).all(axis=1)
    inside &= ((seen >= 0) & (seen <= np.array(camera.size_px) - 1)).all(axis=1)
    misfit = np.full(len(candidates), HIDDEN_PX)
    if inside.any() and len(edges):
        distance, _ = cKDTree(edges.xy_px).query(seen[inside], distance_upper_bound=HIDDEN_PX)
        misfit[inside] = np.minimum(distance, HIDDEN_PX)
    return misfit


def side_cost(
    first: EdgePoints,
    candidates: Candidates,
    greys: tuple[NDArray[Any], NDArray[Any]],
    cost: FloatArray,
) -> FloatArray:
    """Return how much the grey of the more similar side differs, in misfit units, shape (M,).

    Two cameras may see one surface at different brightness. Gain and offset between them are
    fitted beforehand to the candidates that are the best of their point and good by the other
    evidence alone.
    """
    beside_1 = grey_beside(greys[0], first.xy_px, first.normal)[candidates.point]
    # across the crossed chain, towards its brighter side
    normal = np.column_stack([candidates.tangent[:, 1], -candidates.tangent[:, 0]])
    beside_2 = grey_beside(greys[1], candidates.xy_px, normal)
    best = best_rows(cost, candidates.point)
    best = best[cost[best] < GOOD_PX]
    gain, offset = _brightness(beside_1[best].ravel(), beside_2[best].ravel())
    scale = np.ptp(np.quantile(_thinned(greys[1]), [0.001, 0.999]))
    contrast = np.maximum(gain * np.abs(beside_1[:, 1] - beside_1[:, 0]), LEAST_CONTRAST * scale)
    difference = np.sort(np.abs(gain * beside_1 + offset - beside_2), axis=1)
    misfit = np.minimum(difference / (contrast * SIDE_TOLERANCE)[:, None], SIDE_LIMIT)
    return np.asarray(misfit @ [1.0, FAR_WEIGHT])


def _thinned(grey: NDArray[Any]) -> NDArray[Any]:
    """Return every n-th pixel of every n-th row of a large image."""
    step = max(int(np.sqrt(grey.size / ENOUGH_PIXELS)), 1)
    return grey[::step, ::step]


def _brightness(grey_1: FloatArray, grey_2: FloatArray) -> tuple[float, float]:
    """Return gain and offset from the first to the second image; outliers lose their say."""
    if grey_1.size < LEAST_PAIRS or np.ptp(grey_1) == 0.0:
        return 1.0, 0.0
    weight = np.ones_like(grey_1)
    gain, offset = 1.0, float(np.median(grey_2 - grey_1))
    for _ in range(10):
        mean_1, mean_2 = np.average(grey_1, weights=weight), np.average(grey_2, weights=weight)
        spread = np.average((grey_1 - mean_1) ** 2, weights=weight)
        shared = np.average((grey_1 - mean_1) * (grey_2 - mean_2), weights=weight)
        if spread <= 0.0 or shared <= 0.0:
            return 1.0, 0.0
        gain = float(shared / spread)
        offset = float(mean_2 - gain * mean_1)
        error = grey_2 - gain * grey_1 - offset
        width = max(1.4826 * float(np.median(np.abs(error))), 1e-6)
        weight = 1.0 / (1.0 + (error / (2 * width)) ** 2) ** 2
    return gain, offset


def grey_beside(grey: NDArray[Any], xy_px: FloatArray, normal: FloatArray) -> FloatArray:
    """Read the grey on the dark and on the bright side, shape (N, 2)."""
    smooth = cv2.GaussianBlur(grey, (0, 0), 0.7)
    beside = np.empty((len(xy_px), 2))
    for start in range(0, len(xy_px), PLACES_AT_ONCE):
        rows = slice(start, start + PLACES_AT_ONCE)
        for side, sign in enumerate((-1, 1)):
            beside[rows, side] = bilinear(smooth, xy_px[rows] + sign * SIDE_STEP_PX * normal[rows])
    return beside


def _upright(first: EdgePoints, candidates: Candidates) -> tuple[BoolArray, FloatArray]:
    """Mark edges that may run along the sweep axis; return their mm of it per px of chain."""
    along_1 = _cosine(candidates.upright_first, first.tangent[candidates.point])
    along_2 = _cosine(candidates.upright_second, candidates.tangent)
    least = np.cos(UPRIGHT_RAD)
    upright = (np.abs(along_1) > least) & (np.abs(along_2) > least) & (along_1 * along_2 > 0)
    length = np.linalg.norm(candidates.upright_first, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return upright, 1.0 / (length * along_1)


def _chain_misfit(
    first: EdgePoints, upright: Candidates, slope: FloatArray, table: DepthTable
) -> FloatArray:
    """Return the mean misfit of a chain that climbs along the sweep axis, shape (M,)."""
    window = chain_window(first.after, first.before, UPRIGHT_REACH)[upright.point]
    there = window >= 0
    step = first.xy_px[window] - first.xy_px[upright.point][:, None]
    way = np.einsum("nki,ni->nk", step, first.tangent[upright.point])
    height = upright.xyz_mm[:, table.axis, None] + slope[:, None] * way
    misfit = np.where(there, table.at(window, height), 0.0)
    return np.asarray(misfit.sum(axis=1) / there.sum(axis=1))


def _cosine(a: FloatArray, b: FloatArray) -> FloatArray:
    length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.einsum("ni,ni->n", a, b) / length)
