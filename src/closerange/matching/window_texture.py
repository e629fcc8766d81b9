"""Matches of points whose window holds texture: sweep, refinement, checks."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.window_candidates import (
    HOPELESS,
    Places,
    choose_places,
    find_places,
    start_level,
)
from closerange.matching.window_images import ImagePair, clipped_share
from closerange.matching.window_planes import SeedRays, tilt_hypotheses
from closerange.matching.window_refine import Refined, refine_windows
from closerange.matching.window_scores import REACH
from closerange.matching.window_search import Search, segment_omegas, swept_level
from closerange.matching.window_sweep import Sweep

RETURN_PX = 1.5
"""A match, matched back, must return to within this, as for edge matches."""

EVIDENCE = 3.0
"""Least logarithm of the likelihood ratio of the best and the second-best place: twenty to one."""

UNSURE_PX = 0.5
"""Standard deviation along the epipolar curve above which a match is flagged, as for edges."""

MISFIT_PX = 0.5
"""Residual, as a shift of every pixel, above which a window does not lie on one plane: half a pixel
either way is what the next pixel would fit as well."""

FARTHEST_PX = 3.0
"""Way from the swept place, which is good to a pixel or two, that a refinement may go."""

SWEPT_PX = 1.0
"""Standard deviation of a swept place."""

SUPPORT = 0.5
"""Share of a window's information that must belong to the plane found."""

CLIPPED = 0.01
"""Share of a window's pixels at full scale that makes it saturated."""

COMPLETE = 0.7
"""Share of a window that both images must show."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Matches of N points before the last checks; arrays are filled in.

    Attributes
    ----------
    omega : ndarray, shape (N,)
        Inverse depths; NaN without a match.
    std_px, across_px, cost, half_width_px : ndarray, shape (N,)
        As `Refined` and `WindowMatches` have them.
    flags : ndarray of int, shape (N,)
        `Flag` bits.
    """

    omega: FloatArray
    std_px: FloatArray
    across_px: FloatArray
    cost: FloatArray
    half_width_px: FloatArray
    flags: IntArray

    @classmethod
    def empty(cls, count: int) -> Found:
        """Return no matches."""
        omega, std, across, cost, width = (np.full(count, np.nan) for _ in range(5))
        return cls(omega, std, across, cost, width, np.zeros(count, dtype=np.int64))

    def put(self, rows: IntArray | slice, part: Found) -> None:
        """Fill in rows."""
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(part, item.name)


def match_textured(search: Search, rays: SeedRays, size: IntArray, rows: IntArray) -> Found:
    """Match points by the texture around them.

    Parameters
    ----------
    search : Search
        Views and limits.
    rays : SeedRays
        N points of the first view, all with a segment to be searched.
    size : ndarray of int, shape (N,)
        Half-widths of their windows, px.
    rows : ndarray of int, shape (N,)
        Their rows in the sweep.

    Returns
    -------
    Found
        One row for each point.
    """
    pair = search.pair
    if search.there is None:
        omega, _ = segment_omegas(search.pencil, rays, search.volume_mm)
        places = _places(search, rays, omega, size, backward=False)
    else:
        places = _swept_places(search, rays, search.there.select(rows))
    best = _refined(pair, rays, places, size, 0, search.epipolar_px)
    # a rival that is behind by far on all levels stays there
    rival = _refined(
        pair, rays, places, np.where(places.evidence < HOPELESS, size, 0), 1, search.epipolar_px
    )
    evidence, best = _better(rays, places, best, rival)
    held = _held(rays, places, best)
    width = size.astype(np.float64)
    flags = np.zeros(len(rays), dtype=np.int64)
    found = Found(held.omega, held.std_px, held.across_px, held.misfit_px, width, flags)
    there = np.nan_to_num(rays.second.project(rays.at(held.omega)))
    clipped = np.maximum(
        clipped_share(pair.greys[0], rays.xy_px, width), clipped_share(pair.greys[1], there, width)
    )
    lost = ~np.isfinite(held.omega)
    returns = _returns(search, rays, held.omega, size)
    with np.errstate(invalid="ignore"):
        for flag, where in (
            (Flag.not_found, lost),
            (Flag.not_converged, ~held.converged & ~lost),
            (Flag.ambiguous, evidence < EVIDENCE),
            (Flag.poor_fit, ~_fits(best) & ~lost),
            (Flag.aperture, best.std_px > UNSURE_PX),
            (Flag.at_border, best.inside < COMPLETE),
            (Flag.saturated, clipped > CLIPPED),
            (Flag.inconsistent, ~lost & ~returns),
        ):
            flags[where] |= int(flag)
    return found


def refining_scale(half_width: int) -> int:
    """Return how many times smaller the images are in which so large a window is refined.

    More than 41 x 41 pixels cost time and add nothing: such a window is only chosen where the
    details are large.
    """
    return 1 << max((half_width - 1) // 20, 0).bit_length()


def _swept_places(search: Search, rays: SeedRays, swept: tuple[FloatArray, FloatArray]) -> Places:
    """Choose among the places that a sweep of the image has found."""
    tilts = tilt_hypotheses(rays, swept[0][:, 0], REACH)
    images = search.pair.pyramids(swept_level(search.pair))
    return choose_places(rays, *swept, images, tilts, search.others)


def _places(
    search: Search, rays: SeedRays, omega: FloatArray, size: IntArray, *, backward: bool
) -> Places:
    """Sweep along the segments, beginning where eleven samples cover the window."""
    tilts = tilt_hypotheses(rays, np.nanmedian(omega, axis=1), REACH)
    samples = int(np.quantile(np.isfinite(omega).sum(axis=1), 0.9))
    side = min(min(camera.size_px) for camera in (rays.first, rays.second))
    least = start_level(samples, len(tilts), (side, side))
    wanted = np.log2(np.maximum(size, REACH) / REACH).astype(np.int64)
    level = np.maximum(least, wanted)
    result = Places.empty(len(rays))
    for top in np.unique(level):
        rows = np.flatnonzero(level == top)
        here, there = search.pair.pyramids(int(top))
        images = (there, here) if backward else (here, there)
        found = find_places(rays.select(rows), omega[rows], images, tilts, search.others)
        result.put(rows, found)
    return result


def _refined(
    pair: ImagePair,
    rays: SeedRays,
    places: Places,
    size: IntArray,
    column: int,
    epipolar_px: float,
) -> Refined:
    """Refine the best (column 0) or the second-best places."""
    result = Refined.empty(len(rays))
    for width in np.unique(size[size > 0]):
        rows = np.flatnonzero((size == width) & np.isfinite(places.omega[:, column]))
        if not rows.size:
            continue
        scale = refining_scale(int(width))
        part = refine_windows(
            rays.select(rows),
            (places.omega[rows, column], places.tilt[rows, column]),
            places.shape[rows],
            (int(width) // scale, scale),
            pair.level(scale),
            epipolar_px,
        )
        result.put(rows, part)
    return result


def _returns(search: Search, rays: SeedRays, omega: FloatArray, size: IntArray) -> BoolArray:
    """Mark matches that, matched back, come to their points again."""
    result = np.zeros(len(rays), dtype=bool)
    rows = np.flatnonzero(np.isfinite(omega))
    some = rays.select(rows)
    back = search.pencil.reversed()
    there = SeedRays.of(back, rays.second.project(some.at(omega[rows])))
    if search.back is not None:
        result[rows] = _swept_home(search.back, there, some.xy_px)
        return result
    span, flags = segment_omegas(back, there, search.volume_mm)
    good = np.flatnonzero((flags == 0) & np.isfinite(span).any(axis=1))
    if not good.size:
        return result
    rows, there = rows[good], there.select(good)
    places = _places(search, there, span[good], size[rows], backward=True)
    home = rays.first.project(there.at(places.omega[:, 0])) - rays.xy_px[rows]
    # large windows are swept where they are eleven samples wide, to half a sample
    near = np.maximum(RETURN_PX, size[rows] / (2 * REACH))
    with np.errstate(invalid="ignore"):
        result[rows] = np.linalg.norm(home, axis=1) < near
    return result


def _swept_home(back: Sweep, there: SeedRays, xy_px: FloatArray) -> BoolArray:
    """Mark points that one of the pixels around their match, swept back, comes near to."""
    # a swept place is good to half a plane, and the pixels around are as far away
    near = RETURN_PX + back.scale / 2
    result = np.zeros(len(there), dtype=bool)
    for omega in back.near(there.xy_px).T:
        with np.errstate(invalid="ignore"):
            home = there.second.project(there.at(omega)) - xy_px
            result |= np.linalg.norm(home, axis=1) < near
    return result


def _better(
    rays: SeedRays, places: Places, best: Refined, rival: Refined
) -> tuple[FloatArray, Refined]:
    """Choose between the two refined places; return the evidence for the choice."""
    swap = np.isfinite(rival.omega) & (rival.likely > best.likely) & rival.converged
    first, second = _mixed(swap, rival, best), _mixed(swap, best, rival)
    apart = np.linalg.norm(_seen(rays, first) - _seen(rays, second), axis=1)
    with np.errstate(invalid="ignore"):
        other = (apart > 1.0) & np.isfinite(apart)
    refined = first.likely - np.where(other, np.maximum(second.likely, 0.0), 0.0)
    coarse = np.where(swap | ~np.isfinite(places.omega[:, 0]), np.inf, places.evidence)
    return np.minimum(np.where(np.isfinite(first.omega), refined, -np.inf), coarse), first


def _mixed(where: BoolArray, chosen: Refined, other: Refined) -> Refined:
    names = [item.name for item in fields(Refined)]
    return Refined(
        **{name: np.where(where, getattr(chosen, name), getattr(other, name)) for name in names}
    )


def _seen(rays: SeedRays, refined: Refined) -> FloatArray:
    return rays.second.project(rays.at(refined.omega))


def _fits(refined: Refined) -> BoolArray:
    """Mark windows most of which lie on the plane that was found."""
    with np.errstate(invalid="ignore"):
        return np.asarray((refined.misfit_px <= MISFIT_PX) & (refined.support >= SUPPORT))


def _held(rays: SeedRays, places: Places, refined: Refined) -> Refined:
    """Return to the swept place where the refinement ran away from it or does not fit."""
    coarse = places.omega[:, 0]
    pace = np.full(len(rays), np.nan)
    known = np.isfinite(coarse)
    pace[known] = np.linalg.norm(rays.select(known).pace(coarse[known]), axis=1)
    nearest = np.nanmin(np.abs(places.omega - refined.omega[:, None]), axis=1, initial=np.inf)
    with np.errstate(invalid="ignore"):
        near = nearest * pace < FARTHEST_PX
    settled = refined.converged & near & _fits(refined)
    lost = known & ~settled
    values = {item.name: getattr(refined, item.name).copy() for item in fields(Refined)}
    values["omega"][lost], values["std_px"][lost] = coarse[lost], SWEPT_PX
    values["across_px"][lost] = 0.0
    values["converged"] &= near | ~known
    return Refined(**values)
