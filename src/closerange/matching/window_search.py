"""Epipolar segments of textured points, and the sweep of whole images where there are many."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, IntArray, all_finite
from closerange.matching.pencil import Pencil
from closerange.matching.search import epipolar_segment
from closerange.matching.window_candidates import WINDOWS
from closerange.matching.window_images import ImagePair
from closerange.matching.window_planes import SeedRays, tilt_hypotheses
from closerange.matching.window_scores import REACH
from closerange.matching.window_sweep import Sweep, sweep, worth_sweeping
from closerange.rig.camera import Camera

PIECE = 1000
"""Points that are worked on at once."""

SWEPT_PIXELS = 500_000
"""Pixels of the largest level that is swept as a whole, the image itself apart: a camera of higher
resolution shows the same in more pixels, and the rest is found on the way to the finest level."""


@dataclass(frozen=True, slots=True, eq=False)
class Spans:
    """Epipolar segments of N points.

    Attributes
    ----------
    low, high, middle : ndarray, shape (N,)
        Least, largest and median inverse depth on each; NaN where there is none.
    samples : ndarray of int, shape (N,)
        Length, px.
    flags : ndarray of int, shape (N,)
        Why there is none; 0 otherwise.
    """

    low: FloatArray
    high: FloatArray
    middle: FloatArray
    samples: IntArray
    flags: IntArray

    @classmethod
    def of(cls, pencil: Pencil, rays: SeedRays, volume_mm: FloatArray) -> Spans:
        """Measure the segments, some at a time: their samples take a lot of memory."""
        result = cls(
            *(np.full(len(rays), np.nan) for _ in range(3)),
            *(np.zeros(len(rays), dtype=np.int64) for _ in range(2)),
        )
        for start in range(0, len(rays), PIECE):
            part = np.arange(start, min(start + PIECE, len(rays)))
            omega, flags = segment_omegas(pencil, rays.select(part), volume_mm)
            known = np.isfinite(omega)
            some = known.any(axis=1)
            result.flags[part] = np.where((flags == 0) & ~some, int(Flag.outside_image), flags)
            result.samples[part] = known.sum(axis=1)
            rows = part[some]
            result.low[rows] = np.nanmin(omega[some], axis=1)
            result.high[rows] = np.nanmax(omega[some], axis=1)
            # along a segment inverse depths ascend or descend: the median is in the middle
            column = np.abs(
                np.cumsum(known[some], axis=1) - (known[some].sum(axis=1)[:, None] + 1) // 2
            )
            middle = np.where(known[some], column, omega.shape[1]).argmin(axis=1)
            result.middle[rows] = omega[some][np.arange(len(rows)), middle]
        return result

    def select(self, rows: IntArray) -> Spans:
        """Keep some points."""
        return Spans(*(getattr(self, item.name)[rows] for item in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """What all windows of a pair of views share.

    Attributes
    ----------
    pencil : Pencil
        Of the two cameras.
    pair : ImagePair
        Both images.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume.
    epipolar_px : float
        Standard deviation of the epipolar curves.
    others : tuple of (Camera, pyramid)
        Further views.
    there, back : Sweep or None
        Of the first image and of the second one, where so many points are asked for that sweeping
        whole images is the cheaper way; `there` has a row for each point.
    """

    pencil: Pencil
    pair: ImagePair
    volume_mm: FloatArray
    epipolar_px: float
    others: tuple[tuple[Camera, list[NDArray[np.float32]]], ...] = ()
    there: Sweep | None = None
    back: Sweep | None = None

    def swept(self, rays: SeedRays, spans: Spans) -> Search:
        """Sweep the images, if that is the cheaper way for so many points.

        Parameters
        ----------
        rays : SeedRays
            N points.
        spans : Spans
            Of their segments; none may be empty.
        """
        if not len(rays):
            return self
        tilts = len(tilt_hypotheses(rays, spans.middle, REACH))
        level = swept_level(self.pair)
        planes = int(spans.samples.max()) * tilts // (1 << level)
        if not worth_sweeping(len(rays), WINDOWS, planes, self.pair, level):
            return self
        there = sweep(self.pencil, self.pair, rays, (spans.low, spans.high), level)
        back = self.pencil.reversed()
        away = SeedRays.of(back, rays.second.project(rays.at(spans.middle)))
        ends = [1 / rays.second.depth_mm(rays.at(end)) for end in (spans.low, spans.high)]
        good = (ends[0] > 0) & (ends[1] > 0) & all_finite(away.xy_px, 1)
        if not good.any():
            return self
        limits = np.fmin(*ends)[good], np.fmax(*ends)[good]
        home = sweep(back, self.pair, away.select(good), limits, level, backward=True)
        return replace(self, there=there, back=home)


def swept_level(pair: ImagePair) -> int:
    """Return the level on which whole images are swept: at least the first."""
    level = 1
    while max(grey.size for grey in pair.greys) >> 2 * level > SWEPT_PIXELS:
        level += 1
    return level


def segment_omegas(
    pencil: Pencil, rays: SeedRays, volume_mm: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return inverse depths a px apart along the epipolar segments, and why there are none.

    Parameters
    ----------
    pencil : Pencil
        Of the two cameras.
    rays : SeedRays
        N points.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume.

    Returns
    -------
    omega : ndarray, shape (N, K)
        NaN after the last of each segment.
    flags : ndarray of int, shape (N,)
        Those of `EpipolarSegments`.
    """
    segments = epipolar_segment(pencil.first, pencil.second, rays.xy_px, volume_mm)
    length = np.linalg.norm(rays.ray, axis=1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        omega = length / segments.distance_mm
    return np.where(np.isfinite(omega), omega, np.nan), segments.flags.copy()
