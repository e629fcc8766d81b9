"""Correspondences of all edge points of two views: candidates, evidence, continuity, agreement."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.features.edge_chains import chain_window
from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.candidates import Candidates, find_candidates, sweep_axis
from closerange.matching.continuity import NO_MATCH, Choice, choose
from closerange.matching.depth_table import MISFIT_LIMIT_PX
from closerange.matching.edge_covariance import SmoothedMatches, smooth_matches
from closerange.matching.element_weights import best_rows
from closerange.matching.evidence import reward, unary_cost
from closerange.matching.pencil import Pencil
from closerange.matching.repeats import hidden_repeats
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

USUAL = 0.25
"""Quantile of the costs of matches that agree both ways that is taken for what a right one costs.
Of noise and hidden edges some agree by chance, and cost more: the lowest quarter is of others."""

MORE_PX = 1.6
"""What a match may cost more than that before no match is preferred: on plain and on cluttered
scenes one right match in twenty does."""

UNRELATED_PX = 1.65
"""Such a cost above which the images may not be of one scene, and nothing is learnt from it: on
plain scenes it is 0.7 to 1.3, on cluttered ones 1.5, of images that do not belong together 1.8 and
more."""

FEWEST_MUTUAL = 40
"""Matches that agree both ways without which a quantile of their costs says nothing."""

STRAY = 3.0
"""Residual against the smoothed chain, in standard deviations, that is not chance."""

UNSURE_PX = 0.45
"""Standard deviation along the epipolar curve above which a match is flagged: a match is expected
to be right to a pixel, which 97 of 100 of the least certain ones then are (2.2 deviations)."""

SHALLOW_SINE = 0.3
"""Sine between edge and epipolar curve below which uncertainty is blamed on it: 17 degrees."""

ONE_BY_ONE = 250_000
"""Edge points from which on one direction of matching waits for the other: both at once would
take more than 1.5 GB, at 5 to 10 candidates of a point and 0.3 kB of each."""


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
    axis = sweep_axis(pencil)
    ways = ((pencil, edges, greys), (pencil.reversed(), edges[::-1], greys[::-1]))
    most = max(len(edge) for edge in edges)
    with ThreadPoolExecutor(1 if most > ONE_BY_ONE else 2) as pool:
        found = list(pool.map(lambda way: _evidence(way, volume_mm, others), ways))
        no_match = _cost_of_none(edges[1], found, axis)
        forward, backward = pool.map(
            lambda way, evidence: _chosen(way[1][0], evidence, axis, no_match), ways, found
        )
    smooth = smooth_matches(pencil, edges, forward.candidates, forward.choice, axis)
    matches = _judged(pencil, edges, (forward, backward), smooth, volume_mm)
    unsure = _repeated(pencil, edges, greys, (forward, backward), matches.flags == 0, volume_mm)
    return replace(matches, flags=matches.flags | np.where(unsure, int(Flag.ambiguous), 0))


@dataclass(frozen=True, slots=True, eq=False)
class _Evidence:
    """Candidates of one direction, what each costs, and what it costs by two views alone."""

    candidates: Candidates
    cost: FloatArray
    by_two: FloatArray


def _evidence(
    way: tuple[Pencil, tuple[EdgePoints, EdgePoints], tuple[NDArray[Any], NDArray[Any]]],
    volume_mm: FloatArray,
    others: Sequence[tuple[Camera, EdgePoints]],
) -> _Evidence:
    pencil, edges, greys = way
    candidates = find_candidates(pencil, *edges, volume_mm)
    cost = unary_cost(edges[0], candidates, greys, pencil)
    return _Evidence(candidates, cost - reward(candidates, others), cost)


def _cost_of_none(second: EdgePoints, found: Sequence[_Evidence], axis: int) -> float:
    """Return what having no match shall cost: more than what a right one costs in these images.

    On slanted and cluttered parts right matches cost more than on level ones. Which are right is
    not known; that the cheapest of either direction are each other's is a good sign of it.
    """
    there, back = found
    if not len(there.candidates) or not len(back.candidates):
        return NO_MATCH
    best = best_rows(there.cost, there.candidates.point)
    cheapest = best_rows(back.cost, back.candidates.point)
    height = np.full(len(second), np.nan)
    height[back.candidates.point[cheapest]] = back.candidates.xyz_mm[cheapest, axis]
    mutual = _returning(there.candidates.select(best), height, second, axis)
    if mutual.sum() < FEWEST_MUTUAL:
        return NO_MATCH
    # by two views alone: a further one may show nothing of the part
    usual = float(np.quantile(there.by_two[best[mutual]], USUAL))
    if usual > UNRELATED_PX:
        return NO_MATCH
    return min(usual + MORE_PX, MISFIT_LIMIT_PX)


def _chosen(first: EdgePoints, evidence: _Evidence, axis: int, no_match: float) -> _Side:
    candidates = evidence.candidates
    choice = choose(first, candidates, evidence.cost, axis, no_match)
    height = np.full(len(first), np.nan)
    height[choice.matched] = candidates.xyz_mm[choice.candidate[choice.matched], axis]
    # the others, most of them, are done with and would only take up memory
    rows = np.flatnonzero(choice.candidate >= 0)
    kept = candidates.select(choice.candidate[rows])
    candidate = np.full(len(height), -1, dtype=np.int64)
    candidate[rows] = np.arange(len(rows))
    return _Side(kept, replace(choice, candidate=candidate), height)


def _judged(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    sides: tuple[_Side, _Side],
    smooth: SmoothedMatches,
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
            (Flag.ambiguous, choice.matched & _tied(edges[0], choice, TIE_PX)),
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


def _tied(first: EdgePoints, choice: Choice, least_px: float) -> BoolArray:
    """Mark the points around which another place fits the images about as well."""
    window = chain_window(first.after, first.before, TIE_REACH)
    # more than the limit of misfit says no more
    lead = np.clip(choice.lead, -MISFIT_LIMIT_PX, MISFIT_LIMIT_PX)
    there = (window >= 0) & choice.matched[window]
    total = np.where(there, lead[window], 0.0).sum(axis=1)
    return np.asarray(total < least_px * there.sum(axis=1))


def _repeated(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    greys: tuple[NDArray[Any], NDArray[Any]],
    sides: tuple[_Side, _Side],
    relied: BoolArray,
    volume_mm: FloatArray,
) -> BoolArray:
    """Mark matches that fit as well with another repeat, whose place neither view shows."""
    forward, backward = sides
    matched = np.flatnonzero(forward.choice.matched[forward.candidates.point])
    clear = (
        ~_tied(edges[0], forward.choice, MARGIN_PX),
        ~_tied(edges[1], backward.choice, MARGIN_PX),
    )
    chosen = forward.candidates.select(matched)
    return hidden_repeats(pencil, edges, greys, chosen, relied, clear, volume_mm)


def on_rays(pencil: Pencil, xy_px: FloatArray, height_mm: FloatArray, axis: int) -> FloatArray:
    """Return the points of the first camera's rays at given heights, shape (N, 3)."""
    direction = pencil.first.directions(xy_px)
    centre = pencil.first.centre_mm
    way = (height_mm - centre[axis]) / direction[:, axis]
    point: FloatArray = centre + direction * way[:, None]
    return point


def _returns(
    sides: tuple[_Side, _Side], second: EdgePoints, smooth: SmoothedMatches, axis: int
) -> BoolArray:
    """Mark the points whose match, matched back, has the same height."""
    forward, backward = sides
    rows = np.flatnonzero(forward.choice.candidate >= 0)
    chosen = forward.candidates.select(forward.choice.candidate[rows])
    returns = np.zeros(len(smooth.height_mm), dtype=bool)
    returns[rows] = _returning(chosen, backward.height_mm, second, axis)
    return returns


def _returning(
    chosen: Candidates, height_mm: FloatArray, second: EdgePoints, axis: int
) -> BoolArray:
    """Mark the candidates at which the second view's edge points have the same height."""
    returns = np.zeros(len(chosen), dtype=bool)
    for end in (chosen.link, second.after[chosen.link]):
        apart = np.abs(height_mm[end] - chosen.xyz_mm[:, axis]) * chosen.px_per_mm
        with np.errstate(invalid="ignore"):
            returns |= apart < RETURN_PX
    return returns


def _inside(xyz_mm: FloatArray, volume_mm: FloatArray) -> BoolArray:
    return np.asarray(((xyz_mm >= volume_mm[0]) & (xyz_mm <= volume_mm[1])).all(axis=1))
