"""Matches of points on plain surfaces, with the check that they return."""

from __future__ import annotations

import numpy as np

from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.matching.pencil import Pencil
from closerange.matching.window_edges import vote_planes
from closerange.matching.window_planes import SeedRays
from closerange.matching.window_texture import RETURN_PX, UNSURE_PX, Found


def match_plain(
    pencil: Pencil,
    rays: SeedRays,
    middle: FloatArray,
    edges: tuple[EdgePoints, EdgePoints],
    volume_mm: FloatArray,
) -> Found:
    """Match points by the edges around them.

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
    Found
        One row for each point.
    """
    votes = vote_planes(pencil, rays, middle, edges, volume_mm)
    flags = votes.flags.copy()
    with np.errstate(invalid="ignore"):
        flags[votes.std_px > UNSURE_PX] |= int(Flag.aperture)
    rows = np.flatnonzero(np.isfinite(votes.omega))
    if rows.size:
        some = rays.select(rows)
        xyz = some.at(votes.omega[rows])
        back = pencil.reversed()
        there = SeedRays.of(back, rays.second.project(xyz))
        again = vote_planes(back, there, 1.0 / back.first.depth_mm(xyz), edges[::-1], volume_mm)
        home = rays.first.project(there.at(again.omega)) - some.xy_px
        with np.errstate(invalid="ignore"):
            lost = ~(np.linalg.norm(home, axis=1) < RETURN_PX)
        flags[rows[lost]] |= int(Flag.inconsistent)
    across = np.where(np.isfinite(votes.omega), 0.0, np.nan)
    return Found(votes.omega, votes.std_px, across, votes.misfit_px, votes.radius_px, flags)
