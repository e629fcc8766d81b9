"""Heights of matched edges, smoothed along their chains, and how far they may be off.

The error of a match of two edges is the noise of both, which smoothing removes in part, and what
their shapes do not have in common, which it does not: a whole edge is off alike. Its cause is what
one view sees and the other does not: a thin face beside the edge, the far side of a chamfer,
another background. Scatter along the chain and the way back from the second view know nothing of
it; the shape of the edges does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.features.edge_chains import chain_window
from closerange.features.edge_uncertainty import blur_px2, chain_mean
from closerange.features.edges import SCALE_PX, EdgePoints
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.candidates import SHALLOWEST, Candidates
from closerange.matching.chain_fit import fit_chains
from closerange.matching.continuity import Choice
from closerange.matching.pencil import Pencil

UNSHARED = 1 / 3
"""Share of an edge's deviation from an ideal step that the other view's does not have as well. Both
see the same edge in the same light, and what moves it in both does no harm. Measured on rendered
scenes: 0.3 to 0.4."""

OFFSET_PER_BLUR = 1.0
"""Px by which an edge may be off per px^2 that it is more blurred in one view than in the other.

Two steps of weights p and 1 - p at a distance d look like one edge as long as d is below about
2 px; its blur is larger than that of one step by p (1 - p) d^2, its place is off by (1 - p) d, and
their ratio is 1 / (p d), where p d, for the stronger step, is about 1 px."""

CORRELATED = 2 * np.sqrt(np.pi) * SCALE_PX
"""Neighbours on a chain whose noise is one: the gradient of both is taken from the same pixels.
The sum of the autocorrelation exp(-t^2 / 4 s^2) of noise smoothed by a Gaussian of scale s."""

CARRIED = 10
"""Points of a chain over which the heights of matched ones are carried to one without a match. The
smoother forgets within two or three of them; further away the point's own best candidate, doubtful
as it is, says more."""


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedMatches:
    """Heights after smoothing along chains; N points, NaN where there is none.

    Attributes
    ----------
    height_mm : ndarray, shape (N,)
        Along the sweep axis.
    std_px : ndarray, shape (N,)
        Standard deviation along the epipolar curve in the second view, of both edges.
    rate : ndarray, shape (N,)
        Px along that curve per px along the epipolar curve in the first view.
    residual : ndarray, shape (N,)
        Measured minus smoothed, in standard deviations.
    sine : ndarray, shape (N,)
        Of the angle between edge and epipolar curve in the second view.
    """

    height_mm: FloatArray
    std_px: FloatArray
    rate: FloatArray
    residual: FloatArray
    sine: FloatArray


def smooth_matches(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    candidates: Candidates,
    choice: Choice,
    axis: int,
) -> SmoothedMatches:
    """Smooth the chosen heights along the chains of the first view and say how good they are.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    edges : tuple of two EdgePoints
        Of both views; N points in the first.
    candidates : Candidates
        M rows.
    choice : Choice
        What was chosen of them.
    axis : int
        World axis of heights.

    Returns
    -------
    SmoothedMatches
        One row for each edge point of the first view.
    """
    count = len(edges[0])
    rows = np.flatnonzero(choice.candidate >= 0)
    if not rows.size:
        return SmoothedMatches(*(np.full(count, np.nan) for _ in range(5)))
    chosen = candidates.select(choice.candidate[rows])
    # heights as px of one scale: chains are smooth in the image
    px_per_mm = float(np.median(chosen.px_per_mm))
    to_px = px_per_mm / chosen.px_per_mm
    value, sine = np.full(count, np.nan), np.full(count, np.nan)
    value[rows], sine[rows] = chosen.xyz_mm[:, axis] * px_per_mm, chosen.sine
    # a point without a candidate stands between its neighbours, with the usual share of theirs
    noise, shape, weight, pace = (
        _at(rows, part, count) for part in _deviations(pencil, edges, rows, chosen, axis)
    )
    scale = _at(rows, to_px, count)
    std = weight * scale
    fit = fit_chains(edges[0], np.where(choice.matched, value, np.nan), std)
    left = noise * scale * np.minimum(np.sqrt(CORRELATED) * fit.std_px / std, 1.0)
    alone = _forlorn(edges[0], choice)
    left = np.where(choice.matched, left, np.where(alone, std, fit.std_px))
    return SmoothedMatches(
        np.where(alone, value, fit.value_px) / px_per_mm,
        np.hypot(left, shape * scale),
        pace,
        fit.residual,
        sine,
    )


def _forlorn(first: EdgePoints, choice: Choice) -> BoolArray:
    """Mark points with a candidate but without a match on their chain nearby."""
    window = chain_window(first.after, first.before, CARRIED)
    near = ((window >= 0) & choice.matched[window]).any(axis=1)
    return np.asarray((choice.candidate >= 0) & ~near)


def _at(rows: IntArray, values: FloatArray, count: int) -> FloatArray:
    """Spread values to their rows, and their median to all others."""
    spread = np.full(count, np.median(values))
    spread[rows] = values
    return spread


def _deviations(
    pencil: Pencil,
    edges: tuple[EdgePoints, EdgePoints],
    rows: IntArray,
    chosen: Candidates,
    axis: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return what noise and shape do along the epipolar curve in the second view, px.

    And the deviation to be smoothed with, which has all that may change along a chain, and px in
    the second view per px in the first.
    """
    pace, sine_first = _in_first_view(pencil, edges[0].tangent[rows], chosen, axis)
    lever = (pace / sine_first, 1.0 / chosen.sine)

    def both(here: FloatArray, there: FloatArray) -> FloatArray:
        across = np.sqrt(between(there**2, chosen, edges[1]))
        return np.asarray(np.hypot(here[rows] * lever[0], across * lever[1]))

    noise = both(edges[0].noise_px, edges[1].noise_px)
    own = both(edges[0].model_px, edges[1].model_px)
    blur = [chain_mean(blur_px2(edge.width_px2, edge.normal), edge.after) for edge in edges]
    more = between(blur[1], chosen, edges[1]) - blur[0][rows]
    # the more blurred one is off
    merged = OFFSET_PER_BLUR * np.abs(more) * np.where(more > 0, lever[1], lever[0])
    # along a chain any of it may change; a second step beside the edge shows in both alike
    weight = np.hypot(noise, np.maximum(own, merged))
    return noise, np.hypot(UNSHARED * own, merged), weight, pace


def between(value: FloatArray, chosen: Candidates, second: EdgePoints) -> FloatArray:
    """Interpolate a property of the second view's edge points to the crossings, shape (M,)."""
    after = second.after[chosen.link]
    return np.asarray((1 - chosen.share) * value[chosen.link] + chosen.share * value[after])


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
