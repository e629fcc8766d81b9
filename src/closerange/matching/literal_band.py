"""The search neighbourhood as pixels: a band around the epipolar segment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.matching.segment_clipping import SecondView
from closerange.matching.sight import SightLines
from closerange.rig.camera import Camera

WIDEST_PX = 1000.0
"""Widest half-width: beyond it the whole image is the plainer neighbourhood."""

_STEP_PX = 32.0
"""Largest distance of samples of a segment, joined by straight lines: where a lens bends the
segment with a radius of 4000 px (2.7 px over 300), it strays by 0.03 px between two."""

_CHUNK = 32768
"""Pixels that are listed at once: 256 kB a column of numbers, which the cache holds."""


@dataclass(frozen=True, slots=True, eq=False)
class Bands:
    """Pixels of view 2 in which each candidate is looked for; M points, at most L pixels each.

    Attributes
    ----------
    column, row : ndarray, shape (M, L)
        Pixels in view 2, from near to far along the ray; a pixel of the image also where `valid`
        is False.
    valid : ndarray of bool, shape (M, L)
        Which of them belong to the neighbourhood.
    flags : ndarray of int, shape (M,)
        Why there are none: those of `closerange.matching.search.EpipolarSegments`.
    """

    column: NDArray[np.int32]
    row: NDArray[np.int32]
    valid: BoolArray
    flags: IntArray


def bands(camera_2: Camera, rays: SightLines, band_px: float) -> Bands:
    """List the pixels around epipolar segments.

    Parameters
    ----------
    camera_2 : Camera
        View 2.
    rays : SightLines
        Of M points of view 1, cut at the volume.
    band_px : float
        Half-width b. The segment is y = f(x) if it runs more along x than along y; the pixels of
        a column x are those with f(x) - b <= y < f(x) + b, and likewise with x and y exchanged.
        With 0.5, the smallest, there is one pixel a column. Columns reach from the rounded start
        to the rounded end.

    Returns
    -------
    Bands
        For M points.

    Raises
    ------
    InputError
        If the half-width is below 0.5 or above 1000 px.
    """
    if not 0.5 <= band_px <= WIDEST_PX:
        raise InputError(
            f"a band of half-width {band_px} px",
            remedy=f"give 0.5 to {WIDEST_PX:.0f} px: below, it would have gaps",
        )
    lines = _lines(*_curves(camera_2, rays))
    per_column = int(np.ceil(2 * band_px))
    shape = (len(rays), max(int(lines.columns.max(initial=0)), 1) * per_column)
    column, row = np.empty(shape, np.int32), np.empty(shape, np.int32)
    valid = np.empty(shape, np.bool_)
    step = max(_CHUNK // shape[1], 1)
    width, height = camera_2.size_px
    for first in range(0, len(rays), step):
        part = slice(first, first + step)
        along, across, exists = _pixels(lines, part, band_px, per_column)
        upright = lines.upright[part, None]
        x, y = np.where(upright, across, along), np.where(upright, along, across)
        column[part], row[part] = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
        valid[part] = exists & (column[part] == x) & (row[part] == y)
    return Bands(column, row, valid, lines.flags)


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """Segments as functions of the coordinate along which they run; M segments.

    `way`, counted from the start, and `other` are the samples' coordinates, shape (M, K), the
    last one repeated; `start` and `sign` turn ways into coordinates.
    """

    upright: BoolArray
    start: FloatArray
    sign: NDArray[np.int32]
    columns: IntArray
    way: FloatArray
    other: FloatArray
    flags: IntArray


def _curves(camera_2: Camera, rays: SightLines) -> tuple[FloatArray, IntArray]:
    """Return samples of the segments, shape (M, K, 2), 0 where there is none, and their flags.

    What `closerange.matching.search.epipolar_segment` does, with few samples: it spaces them
    by the lens, which takes as long as all the rest.
    """
    view = SecondView(camera_2)
    segments = view.clip(rays)
    length = np.nan_to_num(np.linalg.norm(segments.end - segments.start, axis=1))
    steps = 1 if view.straight else int(np.ceil(float(length.max(initial=0.0)) / _STEP_PX))
    fraction = np.linspace(0.0, 1.0, max(steps, 1) + 1)
    fraction = np.where(np.isfinite(segments.near_mm)[:, None], fraction, np.nan)
    kept, samples = view.clip_samples(segments, fraction)
    seen = np.isfinite(kept)
    # samples outside of the image repeat the last one inside, those before the first the first
    place = np.where(seen, np.arange(seen.shape[1]), -1)
    place = np.maximum(np.maximum.accumulate(place, axis=1), np.argmax(seen, axis=1)[:, None])
    samples = np.nan_to_num(np.take_along_axis(samples, place[..., None], axis=1))
    flags = rays.flags | segments.flags
    nothing = ~seen.any(axis=1) & (flags & ~int(Flag.near_parallel) == 0)
    return samples, np.where(nothing, flags | int(Flag.outside_image), flags)


def _lines(samples: FloatArray, flags: IntArray) -> _Lines:
    """Choose the axis along which each segment runs."""
    ends = samples[:, -1] - samples[:, 0]
    upright = np.abs(ends[:, 1]) > np.abs(ends[:, 0])
    major = np.where(upright[:, None], samples[..., 1], samples[..., 0])
    other = np.where(upright[:, None], samples[..., 0], samples[..., 1])
    start, length = major[:, 0], major[:, -1] - major[:, 0]
    sign = np.where(length < 0, -1, 1).astype(np.int32)
    way = sign[:, None] * (major - start[:, None])
    # a curve that turns back is none that pixels can be listed along
    turns = (np.diff(way, axis=1) < 0).any(axis=1)
    flags = np.where(turns, flags | int(Flag.not_converged), flags)
    columns = np.abs(np.rint(start + length) - np.rint(start)).astype(np.int64) + 1
    columns[flags & ~int(Flag.near_parallel) != 0] = 0
    return _Lines(upright, start, sign, columns, way, other, np.asarray(flags, np.int64))


def _pixels(
    lines: _Lines, part: slice, band_px: float, per_column: int
) -> tuple[NDArray[np.int32], NDArray[np.int32], BoolArray]:
    """Return both coordinates of some segments' pixels, and which exist."""
    place = np.arange(max(int(lines.columns.max(initial=0)), 1), dtype=np.int32)
    start, sign, way = lines.start[part, None], lines.sign[part, None], lines.way[part]
    along = np.rint(start).astype(np.int32) + sign * place
    asked = np.clip(sign * (along - start), 0.0, way[:, -1:])
    # one interpolation for all: each segment has its own stretch of the abscissa
    stretch = 1.0 + float(way.max(initial=0.0))
    shift = stretch * np.arange(len(way))[:, None]
    middle: FloatArray = np.interp(
        (asked + shift).ravel(), (way + shift).ravel(), lines.other[part].ravel()
    ).reshape(asked.shape)
    across = np.ceil(middle - band_px).astype(np.int32)
    exists = place < lines.columns[part, None]
    if per_column == 1:
        return along, across, exists
    wide = across[..., None] + np.arange(per_column, dtype=np.int32)
    inside = exists[..., None] & (wide < middle[..., None] + band_px)
    along = np.repeat(along, per_column, axis=1)
    return along, wide.reshape(along.shape), inside.reshape(along.shape)
