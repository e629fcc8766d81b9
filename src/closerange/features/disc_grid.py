"""Naming the discs of a grid: which candidate is which point of the target."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import DetectionError
from closerange.features.grid_checking import MIN_NEIGHBOURS, clean, size_ratios
from closerange.features.grid_growing import Candidates, grow, lines, seeds
from closerange.features.grid_orientation import (
    LEAST_SEEN,
    place_lattice,
    place_line,
    refusal,
)
from closerange.features.pattern import DiscGrid
from closerange.geometry.arrays import FloatArray, IntArray

MOST_ATTEMPTS = 40
"""Seeds tried before giving up; a target that is there is found from nearly any of its discs."""

EQUAL_SIZE = 2.0
"""A single disc is at least this much larger than any other candidate. Its scale in the image
is unknown, so nothing else tells it from another round thing."""

LINE_SIZE_SPREAD = 2.0
"""Largest over smallest disc of a line of equal discs: perspective from one end to the other."""


def label_discs(xy_px: ArrayLike, ellipse: ArrayLike, grid: DiscGrid) -> IntArray:
    """Find out which candidate is which disc of a grid.

    Parameters
    ----------
    xy_px : array_like, shape (M, 2)
        Centres of disc candidates, px; rows that are not finite are left out.
    ellipse : array_like, shape (M, 3)
        Semi-axes a >= b in px, angle of the major axis from +x towards +y in rad.
    grid : DiscGrid
        The target.

    Returns
    -------
    ndarray of int, shape (N,)
        Row of the candidate of each disc, in the target's order; -1 where a disc is missing.

    Raises
    ------
    DetectionError
        If the target is not in the image or its labels are ambiguous: it names how many
        candidates were found, how many were expected, why, and what to do.

    Notes
    -----
    Any tilt and roll, lens distortion, other things in view and missing inner discs are
    allowed for. Outer rows and columns must show at least two discs, unless marks decide. A
    single row or column must be complete.
    """
    centres = np.asarray(xy_px, dtype=np.float64).reshape(-1, 2)
    shapes = np.asarray(ellipse, dtype=np.float64).reshape(-1, 3)
    usable = np.isfinite(centres).all(axis=1) & np.isfinite(shapes).all(axis=1)
    usable &= (shapes[:, :2] > 0).all(axis=1)
    rows = np.flatnonzero(usable)
    needed = max(1, int(np.ceil(LEAST_SEEN * grid.rows * grid.columns)))
    if len(rows) < needed:
        raise refusal(
            len(rows),
            grid,
            "too few to be the target",
            "check that the target is in view, sharp and evenly lit, and that polarity is right",
        )
    index = _label(centres[rows], shapes[rows], grid)
    return np.where(index >= 0, rows[index], -1)


def _label(xy_px: FloatArray, ellipse: FloatArray, grid: DiscGrid) -> IntArray:
    candidates = Candidates.of(xy_px, ellipse)
    if grid.rows == grid.columns == 1:
        return _single(candidates, grid)
    if grid.rows == 1 or grid.columns == 1:
        return _line(candidates, grid)
    return _grid(candidates, grid)


def _single(candidates: Candidates, grid: DiscGrid) -> IntArray:
    """Take the only candidate, or one that is far larger than all others."""
    order = np.argsort(candidates.radius_px, kind="stable")[::-1]
    radius = candidates.radius_px[order]
    if len(order) > 1 and radius[1] * EQUAL_SIZE > radius[0]:
        raise refusal(
            len(order),
            grid,
            f"two have similar radii, {radius[0]:.1f} and {radius[1]:.1f} px",
            "leave one disc in view, or crop the image",
        )
    return order[:1]


def _line(candidates: Candidates, grid: DiscGrid) -> IntArray:
    """Find the one complete line of the target's length."""
    count = grid.rows * grid.columns
    pitch = grid.pitch_mm[0] if grid.rows == 1 else grid.pitch_mm[1]
    spread = LINE_SIZE_SPREAD * float(np.ptp(np.log(grid.diameters_mm)) + 1)
    found = [
        line
        for line in lines(candidates, pitch, grid)
        if len(line) >= count
        and candidates.radius_px[list(line)].max() < spread * candidates.radius_px[list(line)].min()
    ]
    if len(found) != 1 or len(found[0]) != count:
        longest = max((len(line) for line in found), default=0)
        why = (
            "no straight row of that many at the target's pitch"
            if not found
            else f"{len(found)} rows of discs fit, the longest of {longest}"
        )
        raise refusal(
            len(candidates),
            grid,
            why,
            "bring all discs of the line into view, remove other round things, "
            "and check pitch_mm and disc_diameter_mm",
        )
    return place_line(found[0], candidates, grid)


def _grid(candidates: Candidates, grid: DiscGrid) -> IntArray:
    """Find the one lattice that is the target; refuse if the rest holds another one."""
    if grid.rows * grid.columns <= MIN_NEIGHBOURS:
        return _only_lattice(candidates, grid)
    index = _first_lattice(candidates, grid)
    rest = np.setdiff1d(np.arange(len(candidates)), index)
    if len(rest) >= _least(grid):
        try:
            _first_lattice(candidates.only(rest), grid)
        except DetectionError:
            return index
        raise refusal(
            len(candidates), grid, "two such targets are in view", "leave one of them in view"
        )
    return index


def _only_lattice(candidates: Candidates, grid: DiscGrid) -> IntArray:
    """Find the only group of discs that fits.

    In so small a grid the neighbours do not tell a disc's place to better than the first
    guess, so every seed has its say and all must agree.
    """
    found: dict[tuple[int, ...], IntArray] = {}
    failure: DetectionError | None = None
    for seed in seeds(candidates, grid)[:MOST_ATTEMPTS]:
        try:
            nodes = clean(grow(seed, candidates, grid), candidates, grid)
            if len(nodes) < _least(grid):
                continue
            ratios = size_ratios(nodes, candidates, grid)
            index = place_lattice(nodes, ratios, candidates, grid)
            found[tuple(index)] = index
        except DetectionError as error:
            failure = failure or error
    if len(found) == 1:
        return next(iter(found.values()))
    if found:
        raise refusal(
            len(candidates),
            grid,
            f"{len(found)} groups of discs fit the target",
            "leave one target in view, and no other round things near it",
        )
    raise failure or _no_lattice(candidates, grid, 0)


def _no_lattice(candidates: Candidates, grid: DiscGrid, longest: int) -> DetectionError:
    return refusal(
        len(candidates),
        grid,
        f"at most {longest} stand in a grid of the target's pitch and diameter",
        "bring the whole target into view, sharp and evenly lit; check pitch_mm, "
        "disc_diameter_mm and polarity",
    )


def _least(grid: DiscGrid) -> int:
    """Return how many discs must be seen."""
    return max(4, int(np.ceil(LEAST_SEEN * grid.rows * grid.columns)))


def _first_lattice(candidates: Candidates, grid: DiscGrid) -> IntArray:
    """Grow lattices from the best seeds until one is the target."""
    failure: DetectionError | None = None
    tried: set[int] = set()
    longest = attempts = 0
    for seed in seeds(candidates, grid):
        if seed.index in tried:
            continue
        attempts += 1
        if attempts > MOST_ATTEMPTS:
            break
        try:
            nodes = clean(grow(seed, candidates, grid), candidates, grid)
            longest = max(longest, len(nodes))
            if len(nodes) < _least(grid):
                continue
            tried |= set(nodes.values())
            return place_lattice(nodes, size_ratios(nodes, candidates, grid), candidates, grid)
        except DetectionError as error:
            failure = failure or error
    raise failure or _no_lattice(candidates, grid, longest)
