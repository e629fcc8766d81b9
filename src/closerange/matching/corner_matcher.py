"""Corners of one view found in all others: where the edges that meet there meet in space."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from closerange.features.corners import FEWEST, Corners, find_corners
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray, all_finite
from closerange.matching.all_views import Found, along_and_across, in_all_views
from closerange.matching.candidates import sweep_axis
from closerange.matching.correspondences import Correspondences
from closerange.matching.edge_matcher import EdgeMatches, match_edges, on_rays
from closerange.matching.matcher import ACROSS_PX, View
from closerange.matching.pencil import Pencil
from closerange.matching.sight import checked_volume, inside_image
from closerange.matching.volume_proposal import check_in_view

AGREE = 3.0
"""Standard deviations by which the heights of two arms at their corner may differ."""


def match_corners(
    views: Sequence[View],
    volume_mm: FloatArray,
    *,
    placement: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> Correspondences:
    """Find the corners of the first view in all others.

    The arms of a corner are matched as edges; a line through the heights of each arm is carried
    on to the corner. Two arms that arrive at different heights do not meet in space: one edge
    passes in front of the other, and there is no corner to be found (`ambiguous`).

    Parameters
    ----------
    views : sequence of View
        At least two; the corners are those of the first.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume: where the corners may be. Infinite where there is no limit.
    placement : str, optional
        For the rows of the table.
    progress : callable, optional
        Called with (done, total) after each further view.

    Returns
    -------
    Correspondences
        Named ``c0``, ``c1``, ... from top to bottom; `mismatch` is the misfit in px of the edges
        of the arms.

    Raises
    ------
    InputError, GeometryError
        If the volume is none, or lies behind a camera or outside of the views.
    """
    volume = checked_volume(volume_mm)
    check_in_view([view.camera for view in views], volume)
    first = views[0]
    corners = find_corners(first.pixels, first.edges)
    count = len(corners)
    seeds = Found(
        corners.xy_px, corners.cov_px2, np.full(count, np.nan), np.zeros(count, dtype=np.int64)
    )
    return in_all_views(
        views,
        lambda other, rest: _pair(first, other, rest, volume, corners),
        seeds,
        cameras=[view.camera.name for view in views],
        point=[f"c{row}" for row in range(count)],
        placement=placement,
        progress=progress,
    )


def _pair(
    first: View, second: View, rest: Sequence[View], volume_mm: FloatArray, corners: Corners
) -> Found:
    pencil = Pencil.of(first.camera, second.camera)
    axis = sweep_axis(pencil)
    greys = (first.pixels.astype(np.float32), second.pixels.astype(np.float32))
    others = [(view.camera, view.edges) for view in rest]
    matches = match_edges(pencil, (first.edges, second.edges), greys, volume_mm, others)
    heights = _heights(pencil, corners, matches, axis)
    xyz_mm = on_rays(pencil, corners.xy_px, heights.height_mm, axis)
    xy_px = second.camera.project(xyz_mm)
    way = _way(pencil, xyz_mm, axis)
    rate = np.linalg.norm(way, axis=1)
    unit = way / rate[:, None]
    along = (heights.std_mm * rate) ** 2
    across = np.maximum(0.5 * np.trace(corners.cov_px2, axis1=1, axis2=2), ACROSS_PX**2)
    cov = along_and_across(unit, along, across)
    found = all_finite(xy_px, 1)
    flags = heights.flags.copy()
    flags[found & ~inside_image(second.camera, xy_px)] |= int(Flag.outside_image)
    with np.errstate(invalid="ignore"):
        inside = ((xyz_mm >= volume_mm[0]) & (xyz_mm <= volume_mm[1])).all(axis=1)
    flags[found & ~inside] |= int(Flag.outside_volume)
    flags[~found & (flags == 0)] |= int(Flag.no_edge)
    cov[~found] = np.nan
    return Found(xy_px, cov, heights.mismatch, flags)


@dataclass(frozen=True, slots=True, eq=False)
class _Heights:
    """Heights of N corners, along the sweep axis."""

    height_mm: FloatArray
    std_mm: FloatArray
    mismatch: FloatArray
    flags: IntArray


def _heights(pencil: Pencil, corners: Corners, matches: EdgeMatches, axis: int) -> _Heights:
    count = len(corners)
    height, std, mismatch = (np.full(count, np.nan) for _ in range(3))
    flags = np.zeros(count, dtype=np.int64)
    rate = np.linalg.norm(_way(pencil, matches.xyz_mm, axis), axis=1)
    std_mm = matches.std_px / rate
    for number in range(count):
        mine = corners.corner == number
        point = corners.point[mine]
        fits = []
        for arm in range(int(corners.arm[mine].max()) + 1):
            rows = np.flatnonzero(mine)[corners.arm[mine] == arm]
            rows = rows[matches.flags[corners.point[rows]] == 0]
            if len(rows) >= FEWEST:
                on_arm = corners.point[rows]
                fits.append(
                    _at_corner(corners.along_px[rows], matches.xyz_mm[on_arm, axis], std_mm[on_arm])
                )
        if not fits:
            flags[number] = np.bitwise_or.reduce(matches.flags[point]) or int(Flag.no_edge)
            continue
        value, variance = np.array(fits).T
        height[number] = np.average(value, weights=1 / variance)
        std[number] = np.sqrt(1 / np.sum(1 / variance))
        mismatch[number] = max(0.0, np.mean(matches.cost[point][matches.flags[point] == 0]))
        if (np.abs(value - height[number]) > AGREE * np.sqrt(variance)).any():
            flags[number] = int(Flag.ambiguous)
    return _Heights(height, std, mismatch, flags)


def _at_corner(
    along_px: FloatArray, height_mm: FloatArray, std_mm: FloatArray
) -> tuple[float, float]:
    """Carry the heights of an arm on to its corner; return height and variance.

    Neighbours on a chain were smoothed together and share their errors: the mean is no better
    known than one of them, and only the slope's part shrinks with their number.
    """
    middle = along_px.mean()
    away = along_px - middle
    spread = float(away @ away)
    slope = float(away @ height_mm) / spread
    lever = 1.0 + middle**2 / spread
    return float(height_mm.mean() - slope * middle), float(np.mean(std_mm**2)) * lever


def _way(pencil: Pencil, xyz_mm: FloatArray, axis: int) -> FloatArray:
    """Return px of view 2 per mm of the sweep axis, on the ray of view 1, shape (N, 2)."""
    ray = xyz_mm - pencil.first.centre_mm
    jacobian = pencil.second.project_jacobian(xyz_mm)
    return np.asarray(np.einsum("nij,nj->ni", jacobian, ray / ray[:, axis, None]))
