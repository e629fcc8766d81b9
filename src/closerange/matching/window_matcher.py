"""Correspondences of points that lie on no edge: texture, speckle, centroids of faces and discs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError
from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.pencil import Pencil
from closerange.matching.search import checked_volume, epipolar_segment, inside_image
from closerange.matching.window_candidates import Places, find_places, pyramid, start_level
from closerange.matching.window_edges import vote_planes
from closerange.matching.window_information import (
    ENOUGH_PX,
    HALF_WIDTHS,
    Information,
    chosen_sizes,
    clipped_share,
    noise_map,
)
from closerange.matching.window_planes import SeedRays, tilt_hypotheses
from closerange.matching.window_refine import Level, Refined, refine_windows
from closerange.matching.window_scores import REACH

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

EPIPOLAR_PX = 0.1
"""Standard deviation of epipolar curves: what a good calibration leaves."""

PIECE = 1000
"""Points that are worked on at once."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowMatches:
    """Matches of points by the windows around them; N points.

    Attributes
    ----------
    xyz_mm : ndarray, shape (N, 3)
        World point on the ray of each point; NaN without a match.
    xy_px : ndarray, shape (N, 2)
        Where it was found in the second view: up to a few tenths of a pixel beside the epipolar
        curve if the calibration is off by as much; NaN without a match.
    std_px : ndarray, shape (N,)
        Standard deviation along the epipolar curve in the second view.
    epipolar : ndarray, shape (N, 2)
        Unit vector along that curve.
    cost : ndarray, shape (N,)
        Misfit of the window or of the edges around the point, px along the curve.
    half_width_px : ndarray, shape (N,)
        Of the structuring element that was chosen.
    flags : ndarray of int, shape (N,)
        `Flag` bits; 0 for what may be relied upon.
    """

    xyz_mm: FloatArray
    xy_px: FloatArray
    std_px: FloatArray
    epipolar: FloatArray
    cost: FloatArray
    half_width_px: FloatArray
    flags: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Matches of N points before the last checks; arrays are filled in."""

    omega: FloatArray
    std_px: FloatArray
    across_px: FloatArray
    cost: FloatArray
    half_width_px: FloatArray
    flags: IntArray

    @classmethod
    def empty(cls, count: int) -> _Found:
        numbers = [np.full(count, np.nan) for _ in range(5)]
        return cls(*numbers, np.zeros(count, dtype=np.int64))

    def put(self, rows: IntArray | slice, part: _Found) -> None:
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(part, item.name)


class _Pair:
    """Two images, prepared once for all points and both directions."""

    def __init__(
        self, pencil: Pencil, greys: tuple[NDArray[Any], NDArray[Any]], levels: int
    ) -> None:
        self.pencil = pencil
        first, second = (pyramid(np.asarray(grey, np.float32), levels) for grey in greys)
        self.images = (first, second)
        self.noise = (noise_map(first[0]), noise_map(second[0]))
        self._levels: dict[int, Level] = {}

    def level(self, scale: int) -> Level:
        """Return the images so many times smaller, ready for the refinement."""
        if scale not in self._levels:
            number = scale.bit_length() - 1
            images = tuple(pyramid(part[0], number)[number] for part in self.images)
            # a halving averages over four pixels and more
            noise = tuple(part[::scale, ::scale] / scale for part in self.noise)
            noise = tuple(
                _fitting(part, image.shape) for part, image in zip(noise, images, strict=True)
            )
            self._levels[scale] = Level.of((images[0], images[1]), (noise[0], noise[1]))
        return self._levels[scale]


def match_windows(
    pencil: Pencil,
    greys: tuple[NDArray[Any], NDArray[Any]],
    edges: tuple[EdgePoints, EdgePoints],
    xy_px: ArrayLike,
    volume_mm: ArrayLike,
    *,
    half_width_px: int | None = None,
    epipolar_px: float = EPIPOLAR_PX,
) -> WindowMatches:
    """Match points of the first view by what surrounds them.

    Where there is texture a window is correlated along the epipolar segment and refined; on plain
    surfaces the edges around the point tell its plane. Size and shape of the structuring element
    are chosen for each point from the images.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    greys : tuple of two ndarrays, shape (H, W)
        Grey values of both images, float32; gain and offset between them may be anything.
    edges : tuple of two EdgePoints
        Of both views; empty where only texture is to be matched.
    xy_px : array_like, shape (N, 2)
        Points of the first view.
    volume_mm : array_like, shape (2, 3)
        Measuring volume; infinite where there is no limit.
    half_width_px : int, optional
        One half-width for the refinement of all points instead of a choice for each.
    epipolar_px : float, optional
        Standard deviation of the epipolar curves that the calibration leaves.

    Returns
    -------
    WindowMatches
        One row for each point.

    Raises
    ------
    InputError
        If the images are not as large as the cameras', the volume is none, or the window is
        smaller than 7 x 7 pixels or larger than the image.
    """
    volume = checked_volume(volume_mm)
    points = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
    _check(pencil, greys, half_width_px, epipolar_px)
    found = _Found.empty(len(points))
    rays = SeedRays.of(pencil, points)
    if not len(points):
        return _matches(rays, found, volume)
    job = _Job(pencil, greys, edges, volume, half_width_px, epipolar_px)
    pieces = [slice(start, start + PIECE) for start in range(0, len(points), PIECE)]
    # two at a time: OpenCV, BLAS and SciPy release the interpreter for most of the work
    with ThreadPoolExecutor(2) as pool:
        for rows, part in zip(pieces, pool.map(lambda s: job.match(rays.select(s)), pieces)):
            found.put(rows, part)
    plain = np.flatnonzero(np.isfinite(found.omega) & (found.flags == int(Flag.no_edge)))
    if plain.size:
        found.put(plain, job.plain(rays.select(plain), found.omega[plain]))
    return _matches(rays, found, volume)


class _Job:
    """Everything that does not change from point to point."""

    def __init__(
        self,
        pencil: Pencil,
        greys: tuple[NDArray[Any], NDArray[Any]],
        edges: tuple[EdgePoints, EdgePoints],
        volume_mm: FloatArray,
        half_width_px: int | None,
        epipolar_px: float,
    ) -> None:
        self.pencil, self.edges, self.volume = pencil, edges, volume_mm
        self.fixed, self.epipolar_px = half_width_px, epipolar_px
        self.greys = tuple(np.asarray(grey, np.float32) for grey in greys)
        self.pair = _Pair(pencil, greys, 0)
        for size in HALF_WIDTHS if half_width_px is None else ():
            self.pair.level(_scale(size))

    def match(self, rays: SeedRays) -> _Found:
        """Match points with texture; mark those without as `no_edge`."""
        found = _Found.empty(len(rays))
        omega, flags = _segments(self.pencil, rays, self.volume)
        flags = np.where(inside_image(rays.first, rays.xy_px), flags, int(Flag.outside_image))
        found.flags[:] = flags
        open_rows = np.flatnonzero((flags == 0) & np.isfinite(omega).any(axis=1))
        middle = np.full(len(rays), np.nan)
        middle[open_rows] = np.nanmedian(omega[open_rows], axis=1)
        size = self._sizes(rays, middle)
        textured = open_rows[size[open_rows] > 0]
        if textured.size:
            part = self._textured(rays.select(textured), omega[textured], size[textured])
            found.put(textured, part)
        plain = open_rows[size[open_rows] == 0]
        # left to the edges, for all points at once: the middles are where they begin
        found.omega[plain], found.flags[plain] = middle[plain], int(Flag.no_edge)
        return found

    def _sizes(self, rays: SeedRays, middle: FloatArray) -> IntArray:
        """Return the half-width of each window, px; 0 where there is no texture."""
        known = np.isfinite(middle)
        sizes = np.zeros(len(rays), dtype=np.int64)
        if not known.any():
            return sizes
        widths = HALF_WIDTHS if self.fixed is None else (self.fixed,)
        some = rays.select(known)
        back = np.nan_to_num(some.back(middle[known]))
        information = Information.of(self.greys[0], some.xy_px, widths).along(back) / 2
        enough = ENOUGH_PX if self.fixed is None else UNSURE_PX
        chosen = chosen_sizes(information, widths, enough)
        sizes[known] = np.where(chosen >= 0, np.array(widths)[chosen], 0)
        return sizes

    def _textured(self, rays: SeedRays, omega: FloatArray, size: IntArray) -> _Found:
        places = self._places(self.pencil, rays, omega, size, self.greys)
        best, rival = (self._refined(rays, places, size, column) for column in (0, 1))
        evidence, best = _better(rays, places, best, rival)
        held = _held(rays, places, best)
        found = _Found(
            held.omega,
            held.std_px,
            held.across_px,
            held.misfit_px,
            size.astype(np.float64),
            np.zeros(len(rays), dtype=np.int64),
        )
        seen = _seen(rays, held.omega)
        share = np.maximum(
            clipped_share(self.greys[0], rays.xy_px, found.half_width_px),
            clipped_share(self.greys[1], np.nan_to_num(seen), found.half_width_px),
        )
        lost = ~np.isfinite(held.omega)
        with np.errstate(invalid="ignore"):
            for flag, where in (
                (Flag.not_found, lost),
                (Flag.not_converged, ~held.converged & ~lost),
                (Flag.ambiguous, evidence < EVIDENCE),
                (Flag.poor_fit, ~_fits(best) & ~lost),
                (Flag.aperture, best.std_px > UNSURE_PX),
                (Flag.at_border, best.inside < COMPLETE),
                (Flag.saturated, share > CLIPPED),
                (Flag.inconsistent, ~lost & ~self._returns(rays, held.omega, size)),
            ):
                found.flags[where] |= int(flag)
        return found

    def _places(
        self,
        pencil: Pencil,
        rays: SeedRays,
        omega: FloatArray,
        size: IntArray,
        greys: tuple[NDArray[Any], ...],
    ) -> Places:
        """Sweep along the segments, beginning where eleven samples cover the window."""
        tilts = tilt_hypotheses(rays, np.nanmedian(omega, axis=1), REACH)
        samples = int(np.quantile(np.isfinite(omega).sum(axis=1), 0.9))
        sides = min(min(camera.size_px) for camera in (pencil.first, pencil.second))
        least = start_level(samples, len(tilts), (sides, sides))
        wanted = np.log2(np.maximum(size, REACH) / REACH).astype(np.int64)
        level = np.maximum(least, wanted)
        result = Places.empty(len(rays))
        for top in np.unique(level):
            rows = np.flatnonzero(level == top)
            first, second = (pyramid(grey, int(top)) for grey in greys)
            result.put(rows, find_places(rays.select(rows), omega[rows], (first, second), tilts))
        return result

    def _refined(self, rays: SeedRays, places: Places, size: IntArray, column: int) -> Refined:
        result = Refined.empty(len(rays))
        for width in np.unique(size):
            rows = np.flatnonzero((size == width) & np.isfinite(places.omega[:, column]))
            if not rows.size:
                continue
            some, shape, tilt = rays.select(rows), places.shape[rows], places.tilt[rows, column]
            start, scale = places.omega[rows, column], _scale(int(width))
            part = refine_windows(
                some,
                (start, tilt),
                shape,
                (int(width) // scale, scale),
                self.pair.level(scale),
                self.epipolar_px,
            )
            result.put(rows, part)
        return result

    def _returns(self, rays: SeedRays, omega: FloatArray, size: IntArray) -> BoolArray:
        """Mark matches that, matched back, come to their points again."""
        result = np.zeros(len(rays), dtype=bool)
        rows = np.flatnonzero(np.isfinite(omega))
        if not rows.size:
            return result
        seen = _seen(rays.select(rows), omega[rows])
        backward = self.pencil.reversed()
        there = SeedRays.of(backward, seen)
        span, flags = _segments(backward, there, self.volume)
        good = np.flatnonzero((flags == 0) & np.isfinite(span).any(axis=1))
        if not good.size:
            return result
        places = self._places(
            backward, there.select(good), span[good], size[rows[good]], self.greys[::-1]
        )
        met = there.select(good).at(places.omega[:, 0])
        home = rays.first.project(met) - rays.xy_px[rows[good]]
        # large windows are swept where they are eleven samples wide, to half a sample
        near = np.maximum(RETURN_PX, size[rows[good]] / (2 * REACH))
        with np.errstate(invalid="ignore"):
            result[rows[good]] = np.linalg.norm(home, axis=1) < near
        return result

    def plain(self, rays: SeedRays, middle: FloatArray) -> _Found:
        """Match points on plain surfaces."""
        votes = vote_planes(self.pencil, rays, middle, self.edges, self.volume)
        flags = votes.flags.copy()
        with np.errstate(invalid="ignore"):
            flags[votes.std_px > UNSURE_PX] |= int(Flag.aperture)
        found = np.isfinite(votes.omega)
        rows = np.flatnonzero(found)
        if rows.size:
            some = rays.select(rows)
            seen = _seen(some, votes.omega[rows])
            backward = self.pencil.reversed()
            there = SeedRays.of(backward, seen)
            start = 1.0 / backward.first.depth_mm(some.at(votes.omega[rows]))
            again = vote_planes(backward, there, start, self.edges[::-1], self.volume)
            home = rays.first.project(there.at(again.omega)) - some.xy_px
            with np.errstate(invalid="ignore"):
                lost = ~(np.linalg.norm(home, axis=1) < RETURN_PX)
            flags[rows[lost]] |= int(Flag.inconsistent)
        return _Found(
            votes.omega,
            votes.std_px,
            np.where(found, 0.0, np.nan),
            votes.misfit_px,
            votes.radius_px,
            flags,
        )


def _better(
    rays: SeedRays, places: Places, best: Refined, rival: Refined
) -> tuple[FloatArray, Refined]:
    """Choose between the two refined places; return the evidence for the choice."""
    swap = np.isfinite(rival.omega) & (rival.likely > best.likely) & rival.converged
    first, second = (
        Refined(
            *(
                np.where(swap, getattr(b, item.name), getattr(a, item.name))
                for item in fields(Refined)
            )
        )
        for a, b in ((best, rival), (rival, best))
    )
    apart = np.linalg.norm(_seen(rays, first.omega) - _seen(rays, second.omega), axis=1)
    with np.errstate(invalid="ignore"):
        other = (apart > 1.0) & np.isfinite(apart)
    refined = first.likely - np.where(other, np.maximum(second.likely, 0.0), 0.0)
    coarse = np.where(swap | ~np.isfinite(places.omega[:, 0]), np.inf, places.evidence)
    return np.minimum(np.where(np.isfinite(first.omega), refined, -np.inf), coarse), first


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


def _segments(pencil: Pencil, rays: SeedRays, volume_mm: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return inverse depths a px apart along the segments, shape (N, K), and flags."""
    segments = epipolar_segment(pencil.first, pencil.second, rays.xy_px, volume_mm)
    length = np.linalg.norm(rays.ray, axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return length / segments.distance_mm, segments.flags.copy()


def _seen(rays: SeedRays, omega: FloatArray) -> FloatArray:
    return rays.second.project(rays.at(omega))


def _scale(half_width: int) -> int:
    """Return how many times smaller the images are in which so large a window is refined."""
    return 1 << max((half_width - 1) // 20, 0).bit_length()


def _fitting(values: NDArray[np.float32], shape: tuple[int, ...]) -> NDArray[np.float32]:
    rows, columns = shape
    padded = np.pad(
        values,
        ((0, max(rows - values.shape[0], 0)), (0, max(columns - values.shape[1], 0))),
        mode="edge",
    )
    return padded[:rows, :columns]


def _matches(rays: SeedRays, found: _Found, volume_mm: FloatArray) -> WindowMatches:
    xyz = rays.at(found.omega)
    known = all_finite(xyz, 1)
    pace = np.full((len(rays), 2), np.nan)
    pace[known] = rays.select(known).pace(found.omega[known])
    # omega falls with the way along the ray: the curve runs away from the first camera
    epipolar = -pace / np.linalg.norm(pace, axis=1, keepdims=True)
    # across was counted from the direction of growing omega
    beside = np.column_stack([epipolar[:, 1], -epipolar[:, 0]])
    flags = found.flags.copy()
    with np.errstate(invalid="ignore"):
        outside = known & ~((xyz >= volume_mm[0]) & (xyz <= volume_mm[1])).all(axis=1)
    flags[outside] |= int(Flag.outside_volume)
    flags[~known & (flags == 0)] |= int(Flag.not_found)
    return WindowMatches(
        xyz,
        _seen(rays, found.omega) + found.across_px[:, None] * beside,
        found.std_px,
        epipolar,
        found.cost,
        found.half_width_px,
        flags,
    )


def _check(
    pencil: Pencil,
    greys: tuple[NDArray[Any], NDArray[Any]],
    half_width_px: int | None,
    epipolar_px: float,
) -> None:
    for camera, grey in zip((pencil.first, pencil.second), greys, strict=True):
        width, height = camera.size_px
        if np.shape(grey) != (height, width):
            raise InputError(
                f"the image of camera {camera.name!r} has the shape {np.shape(grey)}, its "
                f"calibration is for {height} rows of {width} pixels",
                remedy="give the whole image of the camera, in grey values",
            )
        if half_width_px is not None and not 3 <= half_width_px <= min(width, height) // 2:
            raise InputError(
                f"windows of {half_width_px} px on each side; possible are 3 to "
                f"{min(width, height) // 2}",
                remedy="leave the size out: it is then chosen for each point",
            )
    if not (np.isfinite(epipolar_px) and epipolar_px > 0):
        raise InputError(
            f"an uncertainty of epipolar curves of {epipolar_px} px",
            remedy="give a number above zero, such as 0.1",
        )
