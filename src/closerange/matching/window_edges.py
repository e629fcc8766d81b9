"""Matches of points on plain surfaces: the edges around a point vote for the plane it lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.candidates import find_candidates
from closerange.matching.evidence import turn
from closerange.matching.pencil import Pencil
from closerange.matching.window_planes import TILT, TILTS, SeedRays

FARTHEST_SHARE = 0.25
"""Radius per image width within which edges are looked for: a face of half the image."""

STEEPEST = 0.3
"""Sine between edge and epipolar curve below which an edge has no vote, as for edge matches."""

TURNED_RAD = 0.6
"""An edge turned further against what the plane predicts is another edge; slants turn them too."""

FEWEST = 12
"""Edge points of a window: twice the shortest chain."""

GAP_RAD = np.pi
"""Widest angle, seen from the point, without an edge: less than that and edges lie around it."""

SURE_GAP_RAD = 0.9 * GAP_RAD
"""The same when the window is grown: some of its edges will have no match."""

NEAREST_PX = 5.0
"""Radius from which on windows are grown."""

MOST_BINS = 20_000
"""Bins of the vote: more than a segment has half pixels."""

EARNED = 0.98
"""Votes of a tilted plane count for so much."""

BIN_PX = 0.5
"""Width of the bins of the vote."""

REACH_PX = 2.0
"""A vote counts to this distance, falling off linearly: edges are off by less than a pixel."""

NEAR_PX = 1.5
"""Edges that agree with the plane to within this take part in the fit."""

AGREEING = 0.5
"""Share of the edges around a point that must lie on one plane with it: else it is only guessed."""

LEAD = 0.8
"""Votes of the second-best plane per those of the best from which on the answer is ambiguous."""

ALIKE = 5.0
"""Neighbours on a chain whose deviation from an ideal edge is one and the same."""

GROSS = 2.5
"""Residual, in standard deviations, at which an edge has a quarter of its weight left."""


@dataclass(frozen=True, slots=True, eq=False)
class PlaneVotes:
    """Planes through N points; columns as in the matches of windows.

    Attributes
    ----------
    omega : ndarray, shape (N,)
        Inverse depth; NaN without enough edges around the point.
    std_px : ndarray, shape (N,)
        Standard deviation along the epipolar curve.
    misfit_px : ndarray, shape (N,)
        Root mean square distance of the agreeing edges from the plane.
    radius_px : ndarray, shape (N,)
        Radius of the window that had to be grown.
    flags : ndarray of int, shape (N,)
        `no_edge`, `poor_fit` (the edges lie on no common plane), `ambiguous`.
    """

    omega: FloatArray
    std_px: FloatArray
    misfit_px: FloatArray
    radius_px: FloatArray
    flags: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Voters:
    """Candidates of edges that have a say, and the edges they belong to."""

    xy_px: FloatArray
    point: IntArray
    omega: FloatArray
    weight: FloatArray
    sine: FloatArray
    std_px: FloatArray


def vote_planes(
    pencil: Pencil,
    rays: SeedRays,
    middle: FloatArray,
    edges: tuple[EdgePoints, EdgePoints],
    volume_mm: FloatArray,
) -> PlaneVotes:
    """Find the planes of points from the edges around them.

    The window of each point grows until edges that cross the epipolar curve lie all around it; the
    nearest ones most likely border the same surface. Every match that each of them may have votes
    for the plane that goes through it, for each hypothesis of the tilt; then a plane is fitted to
    the edges that agree. Edges rather than grey values: beyond the border of a plain face the two
    views see different things, and an edge stays where it is when its contrast changes.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    rays : SeedRays
        N points of the first view.
    middle : ndarray, shape (N,)
        Inverse depths in the middle of their epipolar segments.
    edges : tuple of two EdgePoints
        Of both views.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume.

    Returns
    -------
    PlaneVotes
        One row for each point.
    """
    empty = np.full(len(rays), np.nan)
    nothing = PlaneVotes(empty, empty, empty, empty, np.full(len(rays), int(Flag.no_edge)))
    if not len(rays) or not len(edges[0]) or not len(edges[1]):
        return nothing
    windows = _windows(rays, middle, edges[0])
    wanted = np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *windows]))
    if not wanted.size:
        return nothing
    voters = _voters(pencil, edges[0], wanted, edges[1], volume_mm)
    found = [
        _voted(rays.select([row]), middle[row], voters, window)
        for row, window in enumerate(windows)
    ]
    omega, std, misfit, radius, flags = (np.array(column) for column in zip(*found, strict=True))
    return PlaneVotes(omega, std, misfit, radius, flags.astype(np.int64))


def _windows(rays: SeedRays, middle: FloatArray, edges: EdgePoints) -> list[IntArray]:
    """Return the nearest edge points that lie all around each point; none if none do."""
    farthest = FARTHEST_SHARE * rays.first.size_px[0]
    tree = cKDTree(edges.xy_px)
    back = rays.back(middle)
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    result = []
    for xy, along in zip(rays.xy_px, back, strict=True):
        radius, chosen = NEAREST_PX, np.zeros(0, dtype=np.int64)
        while np.isfinite(along).all():
            near = np.array(tree.query_ball_point(xy, radius, return_sorted=True), dtype=np.int64)
            near = near[np.abs(edges.normal[near] @ along) > STEEPEST]
            if len(near) >= FEWEST and _gap(edges.xy_px[near] - xy) < SURE_GAP_RAD:
                chosen = near
                break
            if radius >= farthest:
                break
            radius = min(radius * np.sqrt(2.0), farthest)
        result.append(chosen)
    return result


def _voters(
    pencil: Pencil,
    first: EdgePoints,
    wanted: IntArray,
    second: EdgePoints,
    volume_mm: FloatArray,
) -> _Voters:
    """Return the matches that the wanted edge points may have."""
    # neighbours tell which way an edge runs through the pencil: they come along
    linked = np.concatenate([wanted, first.after[wanted], first.before[wanted]])
    rows = np.unique(linked[linked >= 0])
    some = first.select(rows)
    candidates = find_candidates(pencil, some, second, volume_mm)
    turned = turn(some, candidates)
    asked = np.isin(rows, wanted)[candidates.point]
    good = asked & (candidates.sine > STEEPEST) & (turned < TURNED_RAD)
    kept, turned = candidates.select(good), turned[good]
    here = np.hypot(some.noise_px, some.model_px * np.sqrt(ALIKE))[kept.point]
    there = np.hypot(second.noise_px, second.model_px * np.sqrt(ALIKE))[kept.link]
    point = rows[kept.point]
    return _Voters(
        first.xy_px,
        point,
        1.0 / pencil.first.depth_mm(kept.xyz_mm),
        1.0 - turned / TURNED_RAD / 2,
        kept.sine,
        np.hypot(here, there) / kept.sine,
    )


def _voted(
    ray: SeedRays, middle: float, voters: _Voters, window: IntArray
) -> tuple[float, float, float, float, int]:
    """Return omega, std, misfit, radius and flags of one point."""
    rows = _members(voters.point, window)
    if not rows.size:
        return np.nan, np.nan, np.nan, np.nan, int(Flag.no_edge)
    point = voters.point[rows]
    place = voters.xy_px[point] - ray.xy_px[0]
    omega = np.array([middle])
    pace = float(np.linalg.norm(ray.pace(omega)))
    unit = [ray.slope(np.ones(1), tilt[None])[0] for tilt in TILTS]
    # a plane is omega (1 + unit . offset): what each candidate says about omega at the point
    said = np.stack([voters.omega[rows] / (1 + place @ slope) for slope in unit])
    tilt, centre, rivalry = _tally(said, voters.weight[rows], pace)
    agree = np.abs(said[tilt] - centre) * pace * voters.sine[rows] < NEAR_PX
    members = np.unique(point[agree])
    flags = int(Flag.ambiguous) if rivalry > LEAD else 0
    around = _gap(voters.xy_px[members] - ray.xy_px[0]) < GAP_RAD
    if len(members) < AGREEING * len(window) or not around:
        flags |= int(Flag.poor_fit)
    if not members.size:
        return np.nan, np.nan, np.nan, np.nan, flags
    steps = [ray.slope(omega, (TILTS[tilt] + TILT * one)[None])[0] for one in np.eye(2)]
    span = (np.stack(steps) - unit[tilt] * middle) * pace
    shift, std, misfit = _fitted(
        (voters.omega[rows][agree] - centre * (1 + place[agree] @ unit[tilt])) * pace,
        place[agree],
        voters.std_px[rows][agree],
        span.T @ span,
    )
    radius = float(np.linalg.norm(voters.xy_px[window] - ray.xy_px[0], axis=1).max())
    return centre + shift / pace, std, misfit, radius, flags


def _members(point: IntArray, window: IntArray) -> IntArray:
    """Return the rows of ascending `point` that are in ascending `window`."""
    start = np.searchsorted(point, window, side="left")
    count = np.searchsorted(point, window, side="right") - start
    offset = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.asarray(np.repeat(start, count) + offset, dtype=np.int64)


def _gap(offset: FloatArray) -> float:
    """Return the widest angle without any point, rad."""
    if len(offset) < 2:
        return 2 * np.pi
    angle = np.sort(np.arctan2(offset[:, 1], offset[:, 0]))
    return float(np.diff(np.r_[angle, angle[0] + 2 * np.pi]).max())


def _tally(said: FloatArray, weight: FloatArray, pace: float) -> tuple[int, float, float]:
    """Return tilt and omega with the most votes, and the share that the best other omega has."""
    low, high = float(said.min()), float(said.max())
    reach = int(REACH_PX / BIN_PX)
    bins = min(int((high - low) * pace / BIN_PX) + 1, MOST_BINS) + 2 * reach
    width = max((high - low) / (bins - 2 * reach), 1e-15)
    column = np.clip(((said - low) / width).astype(np.int64) + reach, 0, bins - 1)
    kernel = 1 - np.abs(np.arange(-reach, reach + 1)) / reach
    votes = np.stack(
        [
            np.convolve(np.bincount(row, weight, minlength=bins), kernel, mode="same")
            for row in column
        ]
    )
    # a tilt must earn its place: with edges on one line all tilts fit alike
    votes[1:] *= EARNED
    tilt, place = (int(part) for part in np.unravel_index(int(votes.argmax()), votes.shape))
    away = np.abs(np.arange(bins) - place) > 2 * reach
    rivalry = float(votes[:, away].max(initial=0.0)) / max(float(votes.max()), 1e-12)
    return tilt, low + (place - reach + 0.5) * width, rivalry


def _fitted(
    shift: FloatArray, place: FloatArray, std: FloatArray, loose: FloatArray
) -> tuple[float, float, float]:
    """Fit a plane to shifts, px; return its value at the point, standard deviation, misfit."""
    basis = np.column_stack([np.ones(len(shift)), place])
    prior = np.zeros((3, 3))
    prior[1:, 1:] = np.linalg.inv(loose + np.eye(2) * max(1e-6 * np.trace(loose), 1e-10))
    weight = std**-2
    trust, scale = np.ones(len(shift)), 1.0
    unknown: FloatArray = np.zeros(3)
    normal: FloatArray = prior
    for _ in range(6):
        weighted = basis * (weight * trust)[:, None]
        normal = weighted.T @ basis + prior * scale
        unknown = np.linalg.solve(normal, weighted.T @ shift)
        residual = (shift - basis @ unknown) * np.sqrt(weight)
        scale = max(float(1.4826 * np.median(np.abs(residual))), 0.3) ** 2
        trust = 1 / (1 + residual**2 / (scale * GROSS**2)) ** 2
    spread = np.average((shift - basis @ unknown) ** 2, weights=weight * trust)
    excess = max(scale, 1.0)
    cov = np.linalg.inv(normal) * excess
    return float(unknown[0]), float(np.sqrt(cov[0, 0])), float(np.sqrt(spread))
