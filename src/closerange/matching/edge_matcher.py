"""Correspondences of all edge points of two views: candidates, evidence, continuity, agreement."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.features.edge_chains import chain_window
from closerange.features.edge_uncertainty import chain_mean
from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.candidates import SHALLOWEST, Candidates, find_candidates, sweep_axis
from closerange.matching.chain_fit import fit_chains
from closerange.matching.continuity import Choice, choose
from closerange.matching.depth_table import MISFIT_LIMIT_PX
from closerange.matching.evidence import unary_cost
from closerange.matching.pencil import Pencil
from closerange.rig.camera import Camera

RETURN_PX = 1.5
"""A match, matched back, must return to within this: the crossing lies between two pixels of a
chain, each of which may be off by half a pixel."""

MARGIN_PX = 1.0
"""Cost by which the best other place must be worse: one pixel of misfit."""

TIE_PX = 0.5
"""Lead of the chosen place over the best other one, by the images alone, in px of misfit and in the
mean along the chain, below which the choice is a matter of chance: half a pixel is what noise and
sampling leave. The margin cannot tell: it sums along the chain what was chance at every point, so
that of equal stripes one wins clearly."""

TIE_REACH = 10
"""Points of the chain on each side over which that lead is averaged."""

STRAY = 3.0
"""Residual against the smoothed chain, in standard deviations, that is not chance."""

UNSURE_PX = 0.5
"""Standard deviation along the epipolar curve above which a match is flagged: two of them are
about a pixel, and a match is expected to be right to that."""

WIDER = 1.15
"""Ratio of second moments that noise and the angle of view explain."""

SHALLOW_SINE = 0.3
"""Sine between edge and epipolar curve below which uncertainty is blamed on it: 17 degrees."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgeMatches:
    """Matches of the edge points of the first view; N points.

    Attributes
    ----------
    xyz_mm : ndarray, shape (N, 3)
        World point on the ray of each edge point; NaN without a match.
    std_px : ndarray, shape (N,)
        Standard deviation along the epipolar curve in the second view, of both edges.
    rate : ndarray, shape (N,)
        Px along that curve per px along the epipolar curve in the first view.
    epipolar : ndarray, shape (N, 2)
        Unit vector along that curve.
    cost : ndarray, shape (N,)
        Mismatch, px.
    flags : ndarray of int, shape (N,)
        `Flag` bits; 0 for what may be relied upon.
    """

    xyz_mm: FloatArray
    std_px: FloatArray
    rate: FloatArray
    epipolar: FloatArray
    cost: FloatArray
    flags: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One direction of matching."""

    candidates: Candidates
    choice: Choice
    height_mm: FloatArray


def match_edges(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    greys: tuple[NDArray[Any], NDArray[Any]],
    volume_mm: FloatArray,
    others: Sequence[tuple[Camera, EdgePoints]] = (),
) -> EdgeMatches:
    """Match the edge points of the first view.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    edges : tuple of two EdgePoints
        Of both views.
    greys : tuple of two ndarrays, shape (H, W)
        Grey values of both images, float32.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume; infinite where there is no limit.
    others : sequence of (Camera, EdgePoints), optional
        Further views, which have a say in the choice.

    Returns
    -------
    EdgeMatches
        One row for each edge point of the first view.
    """
    with ThreadPoolExecutor(2) as pool:
        there = pool.submit(_matched, pencil, edges, greys, volume_mm, others)
        back = pool.submit(_matched, pencil.reversed(), edges[::-1], greys[::-1], volume_mm, others)
        forward, backward = there.result(), back.result()
    smooth = _smoothed(pencil, edges, forward, sweep_axis(pencil))
    return _judged(pencil, edges, (forward, backward), smooth, volume_mm)


def _matched(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    greys: tuple[NDArray[Any], NDArray[Any]],
    volume_mm: FloatArray,
    others: Sequence[tuple[Camera, EdgePoints]],
) -> _Side:
    axis = sweep_axis(pencil)
    candidates = find_candidates(pencil, *edges, volume_mm)
    cost = unary_cost(edges[0], candidates, greys, pencil, others)
    choice = choose(edges[0], candidates, cost, axis)
    height = np.full(len(edges[0]), np.nan)
    height[choice.matched] = candidates.xyz_mm[choice.candidate[choice.matched], axis]
    return _Side(candidates, choice, height)


@dataclass(frozen=True, slots=True, eq=False)
class _Smoothed:
    """Heights after smoothing along chains; N points."""

    height_mm: FloatArray
    std_px: FloatArray
    rate: FloatArray
    residual: FloatArray
    sine: FloatArray


def _smoothed(
    pencil: Pencil, edges: tuple[EdgePoints, EdgePoints], side: _Side, axis: int
) -> _Smoothed:
    count = len(edges[0])
    rows = np.flatnonzero(side.choice.candidate >= 0)
    if not rows.size:
        return _Smoothed(*(np.full(count, np.nan) for _ in range(5)))
    chosen = side.candidates.select(side.choice.candidate[rows])
    px_per_mm = float(np.median(chosen.px_per_mm))
    to_px = px_per_mm / chosen.px_per_mm
    pace, sine_first = _in_first_view(pencil, edges[0].tangent[rows], chosen, axis)
    along_first = pace / sine_first
    merged = _merged(edges, rows, chosen)
    noise = np.hypot(
        edges[0].noise_px[rows] * along_first,
        _between(edges[1].noise_px, chosen, edges[1]) / chosen.sine,
    )
    model = np.hypot(
        np.hypot(edges[0].model_px[rows], merged[0]) * along_first,
        np.hypot(_between(edges[1].model_px, chosen, edges[1]), merged[1]) / chosen.sine,
    )
    std, value, sine = (np.full(count, np.nan) for _ in range(3))
    # a point without a candidate stands between its neighbours, with the usual share of theirs
    common, rate = (np.full(count, np.median(usual)) for usual in (model * to_px, pace))
    std[rows], common[rows] = np.hypot(noise, model) * to_px, model * to_px
    value[rows], sine[rows] = chosen.xyz_mm[:, axis] * px_per_mm, chosen.sine
    rate[rows] = pace
    fit = fit_chains(edges[0], np.where(side.choice.matched, value, np.nan), std)
    # smoothing removes noise; what the edge is not, its neighbours share
    return _Smoothed(
        fit.value_px / px_per_mm, np.hypot(fit.std_px, common), rate, fit.residual, sine
    )


def _merged(
    edges: tuple[EdgePoints, EdgePoints], rows: IntArray, chosen: Candidates
) -> tuple[FloatArray, FloatArray]:
    """Return how far edges may be off that are wider in one view than in the other, px.

    A face that is seen at a low angle is so thin in one view that its two edges look like one,
    wider than it should be. Two steps of weights p and 1 - p at a distance d enlarge the second
    moment by p (1 - p) d^2, which is also the mean square distance of the steps from the middle.
    """
    width = [chain_mean(edge.width_px2, edge.after) for edge in edges]
    here = width[0][rows]
    there = _between(np.sqrt(width[1]), chosen, edges[1]) ** 2
    usual = [
        np.quantile(wide[edge.strength >= np.median(edge.strength)], 0.3)
        for wide, edge in zip(width, edges, strict=True)
    ]
    sharp = np.minimum(here, there)
    return (
        np.sqrt(np.maximum(here - WIDER * np.maximum(sharp, usual[0]), 0.0)),
        np.sqrt(np.maximum(there - WIDER * np.maximum(sharp, usual[1]), 0.0)),
    )


def _between(value: FloatArray, chosen: Candidates, second: EdgePoints) -> FloatArray:
    """Interpolate a property of the second view's edge points to the crossings."""
    after = second.after[chosen.link]
    return np.asarray(
        np.sqrt((1 - chosen.share) * value[chosen.link] ** 2 + chosen.share * value[after] ** 2)
    )


def _in_first_view(
    pencil: Pencil, tangent: FloatArray, chosen: Candidates, axis: int
) -> tuple[FloatArray, FloatArray]:
    """Return px in the second view per px in the first, along the epipolar curves of both.

    And the sine of the angle between edge and curve in the first view.
    """
    ray = chosen.xyz_mm - pencil.second.centre_mm
    jacobian = pencil.first.project_jacobian(chosen.xyz_mm)
    moved = np.einsum("nij,nj->ni", jacobian, ray / ray[:, axis, None])
    length = np.linalg.norm(moved, axis=1)
    across = np.abs(moved[:, 0] * tangent[:, 1] - moved[:, 1] * tangent[:, 0])
    return chosen.px_per_mm / length, np.maximum(across / length, SHALLOWEST)


def _judged(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    sides: tuple[_Side, _Side],
    smooth: _Smoothed,
    volume_mm: FloatArray,
) -> EdgeMatches:
    axis = sweep_axis(pencil)
    choice = sides[0].choice
    xyz_mm = on_rays(pencil, edges[0].xy_px, smooth.height_mm, axis)
    by_second = pencil.second.project_jacobian(xyz_mm)
    ray = xyz_mm - pencil.first.centre_mm
    moved = np.einsum("nij,nj->ni", by_second, ray / ray[:, axis, None])
    flags = np.zeros(len(edges[0]), dtype=np.int64)
    with np.errstate(invalid="ignore"):
        unsure = smooth.std_px > UNSURE_PX
        for flag, where in (
            (Flag.no_edge, choice.candidate < 0),
            (Flag.occluded, (choice.candidate >= 0) & ~choice.matched),
            (Flag.inconsistent, choice.matched & ~_returns(sides, edges[1], smooth, axis)),
            (Flag.ambiguous, choice.matched & (choice.margin < MARGIN_PX)),
            (Flag.ambiguous, choice.matched & _tied(edges[0], choice)),
            (Flag.residual, np.abs(smooth.residual) > STRAY),
            (Flag.aperture, unsure & (smooth.sine < SHALLOW_SINE)),
            (Flag.poor_fit, unsure & (smooth.sine >= SHALLOW_SINE)),
            (Flag.outside_volume, ~_inside(xyz_mm, volume_mm) & np.isfinite(smooth.height_mm)),
        ):
            flags[where] |= int(flag)
    return EdgeMatches(
        xyz_mm,
        smooth.std_px,
        smooth.rate,
        moved / np.linalg.norm(moved, axis=1, keepdims=True),
        choice.cost,
        flags,
    )


def _tied(first: EdgePoints, choice: Choice) -> BoolArray:
    """Mark the points around which another place fits the images about as well."""
    window = chain_window(first.after, first.before, TIE_REACH)
    # more than the limit of misfit says no more
    lead = np.clip(choice.lead, -MISFIT_LIMIT_PX, MISFIT_LIMIT_PX)
    there = (window >= 0) & choice.matched[window]
    total = np.where(there, lead[window], 0.0).sum(axis=1)
    return np.asarray(total < TIE_PX * there.sum(axis=1))


def on_rays(pencil: Pencil, xy_px: FloatArray, height_mm: FloatArray, axis: int) -> FloatArray:
    """Return the points of the first camera's rays at given heights, shape (N, 3)."""
    direction = pencil.first.directions(xy_px)
    centre = pencil.first.centre_mm
    way = (height_mm - centre[axis]) / direction[:, axis]
    point: FloatArray = centre + direction * way[:, None]
    return point


def _returns(
    sides: tuple[_Side, _Side], second: EdgePoints, smooth: _Smoothed, axis: int
) -> BoolArray:
    """Mark the points whose match, matched back, has the same height."""
    forward, backward = sides
    rows = np.flatnonzero(forward.choice.candidate >= 0)
    chosen = forward.candidates.select(forward.choice.candidate[rows])
    returns = np.zeros(len(smooth.height_mm), dtype=bool)
    for end in (chosen.link, second.after[chosen.link]):
        apart = np.abs(backward.height_mm[end] - chosen.xyz_mm[:, axis]) * chosen.px_per_mm
        with np.errstate(invalid="ignore"):
            returns[rows] |= apart < RETURN_PX
    return returns


def _inside(xyz_mm: FloatArray, volume_mm: FloatArray) -> BoolArray:
    return np.asarray(((xyz_mm >= volume_mm[0]) & (xyz_mm <= volume_mm[1])).all(axis=1))
