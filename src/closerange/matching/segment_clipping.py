"""Segments of rays as another camera sees them: clipped to its image, with exact ends."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.sight import SightLines, inside_image
from closerange.rig.camera import Camera

_POINT_PX = 1e-6
"""A segment shorter than this is a point: the ray passes through the other camera's centre and
its image says nothing about the depth. No one measures a millionth of a pixel."""

_POINT_MM = 1e-6
"""A volume thinner than this along the ray is a plane, whose images are points in good order."""

_BISECTIONS = 40
"""Halvings of one step of a segment: 2^-40 of a pixel is where float64 ends."""

_BORDER = 33
"""Samples along each side of an image that show where a lens moves the border."""

_COARSE = 9
"""Samples that show how a lens stretches a segment: a polynomial, smooth across the image."""

_STRAIGHT_PX = 1e-9
"""A lens that moves nothing by more than this is none: rounding alone moves by 1e-12 px."""


@dataclass(frozen=True, slots=True, eq=False)
class IdealSegments:
    """Straight segments in ideal px, a little longer than the image shows; N rows.

    A place on a segment is a fraction from `start` to `end`.

    Attributes
    ----------
    start, end : ndarray, shape (N, 2)
        Ideal px of the ends.
    near_mm, far_mm : ndarray, shape (N,)
        Distances of the ends along the ray of the first camera; NaN where there is none.
    near_depth, far_depth : ndarray, shape (N,)
        Depths of the ends in the second camera, in any unit.
    flags : ndarray of int, shape (N,)
        `behind_camera` and `outside_image` where there is none; `near_parallel` for a point.
    """

    start: FloatArray
    end: FloatArray
    near_mm: FloatArray
    far_mm: FloatArray
    near_depth: FloatArray
    far_depth: FloatArray
    flags: IntArray

    def at(self, fraction: FloatArray) -> FloatArray:
        """Return ideal px, shape (N, K, 2), at fractions (N, K)."""
        share = fraction[..., None]
        return np.asarray((1 - share) * self.start[:, None] + share * self.end[:, None])

    def distance_mm(self, fraction: FloatArray) -> FloatArray:
        """Return distances along the ray, (N, K): equal steps in px are not equal in space."""
        far = fraction * self.near_depth[:, None]
        near = (1 - fraction) * self.far_depth[:, None]
        total = far + near
        share = np.divide(far, total, out=np.zeros_like(total), where=total > 0)
        distance = (1 - share) * self.near_mm[:, None] + share * self.far_mm[:, None]
        return np.asarray(np.where(np.isfinite(fraction), distance, np.nan))

    def select(self, rows: IntArray) -> IdealSegments:
        """Keep some rows, in the given order and as often as they are named."""
        return IdealSegments(*(getattr(self, field.name)[rows] for field in fields(self)))


class SecondView:
    """A camera in whose image segments are looked for, with what is asked of it again and again.

    Parameters
    ----------
    camera : Camera
        Any lens.
    """

    def __init__(self, camera: Camera) -> None:
        width, height = camera.size_px
        across, down = (np.linspace(-0.5, side - 0.5, _BORDER) for side in (width, height))
        grid = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
        ideal = camera.undistort(grid)
        self.camera = camera
        self.straight = bool(np.allclose(ideal, grid, rtol=0, atol=_STRAIGHT_PX))
        self.lower, self.upper = _bounds(camera, grid if self.straight else ideal)

    def clip(self, lines: SightLines) -> IdealSegments:
        """Clip rays to what the image may show; exact, for each bound is linear along a ray.

        Parameters
        ----------
        lines : SightLines
            Rays of another camera.

        Returns
        -------
        IdealSegments
            One row a ray.
        """
        matrix = self.camera.projection_matrix
        origin = matrix[:, :3] @ lines.centre_mm + matrix[:, 3]
        slope = lines.direction @ matrix[:, :3].T
        # in front by a hair, in proportion to the ray's own length: at depth 0 there is no image
        hair = 1e-12 * (np.abs(origin[2]) + np.abs(lines.far_mm * slope[:, 2]))
        near, far = _cut(lines.near_mm, lines.far_mm, origin[2] - hair, slope[:, 2])
        met = lines.flags == 0
        behind = met & ~(near <= far)
        for axis in (0, 1):
            for sign, limit in ((1, self.lower[axis]), (-1, self.upper[axis])):
                offset = sign * (origin[axis] - limit * origin[2])
                near, far = _cut(near, far, offset, sign * (slope[:, axis] - limit * slope[:, 2]))
        missed = met & ~behind & ~(near <= far)
        gone = ~met | behind | missed
        near, far = np.where(gone, np.nan, near), np.where(gone, np.nan, far)
        ends = [origin + distance[:, None] * slope for distance in (near, far)]
        start, end = (point[:, :2] / point[:, 2:] for point in ends)
        point = np.linalg.norm(end - start, axis=1) < _POINT_PX
        flags = np.zeros(len(lines), np.int64)
        flags[behind] = int(Flag.behind_camera)
        flags[missed] = int(Flag.outside_image)
        flags[point & (lines.far_mm - lines.near_mm > _POINT_MM)] = int(Flag.near_parallel)
        return IdealSegments(start, end, near, far, ends[0][:, 2], ends[1][:, 2], flags)

    def observe(self, segments: IdealSegments, fraction: FloatArray) -> FloatArray:
        """Return observed px, shape (N, K, 2), at fractions (N, K)."""
        pixels = segments.at(fraction)
        if self.straight:
            return pixels
        observed = self.camera.distortion.distort(pixels.reshape(-1, 2), self.camera.matrix_px)
        return observed.reshape(pixels.shape)

    def fractions(self, segments: IdealSegments, step_px: float) -> FloatArray:
        """Choose samples so that no step of an observed curve exceeds a limit.

        Parameters
        ----------
        segments : IdealSegments
            N segments.
        step_px : float
            The limit.

        Returns
        -------
        ndarray, shape (N, K)
            Evenly spaced from 0 to 1; NaN after the last, and where there is no segment.
        """
        exists = segments.near_mm <= segments.far_mm
        longest = np.linalg.norm(segments.end - segments.start, axis=1)
        if not self.straight:
            coarse = np.broadcast_to(np.linspace(0, 1, _COARSE), (len(exists), _COARSE))
            chords = np.linalg.norm(np.diff(self.observe(segments, coarse), axis=1), axis=2)
            # between coarse samples the lens stretches by at most a neighbour's difference more;
            # where its model ends there is nothing to see
            uneven = np.abs(np.nan_to_num(np.diff(chords, axis=1))).max(axis=1)
            longest = (np.nan_to_num(chords).max(axis=1) + uneven) * (_COARSE - 1)
        steps = np.ceil(np.nan_to_num(longest) / step_px - 1e-9)  # 3 / 0.1 is 30 steps, not 31
        count = np.where(exists, np.maximum(steps, 1) + 1, 0)
        place = np.arange(max(int(count.max(initial=0)), 1), dtype=np.float64)
        fraction = place / np.maximum(count - 1, 1)[:, None]
        return np.asarray(np.where(place < count[:, None], fraction, np.nan))

    def clip_samples(
        self, segments: IdealSegments, fraction: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Drop samples outside of the image; put exact ends where a curve crosses its border.

        Parameters
        ----------
        segments : IdealSegments
            N segments.
        fraction : ndarray, shape (N, K)
            Samples, as from `fractions`.

        Returns
        -------
        fraction : ndarray, shape (N, K)
            NaN for samples outside; the first one outside has moved to the border.
        observed : ndarray, shape (N, K, 2)
            Their observed px; NaN likewise.
        """
        observed = self.observe(segments, fraction)
        inside = inside_image(self.camera, observed)
        kept = np.where(inside, fraction, np.nan)
        observed[~inside] = np.nan
        next_in = np.pad(inside[:, 1:], ((0, 0), (0, 1)))
        last_in = np.pad(inside[:, :-1], ((0, 0), (1, 0)))
        for neighbour, shift in ((next_in, 1), (last_in, -1)):
            rows, columns = np.nonzero(~inside & neighbour & np.isfinite(fraction))
            if len(rows):
                crossed = segments.select(rows)
                outer, inner = fraction[rows, columns], fraction[rows, columns + shift]
                place = self._crossing(crossed, outer=outer, inner=inner)
                kept[rows, columns] = place
                observed[rows, columns] = self.observe(crossed, place[:, None])[:, 0]
        return kept, observed

    def _crossing(
        self, segments: IdealSegments, *, outer: FloatArray, inner: FloatArray
    ) -> FloatArray:
        """Halve the step from an outer to an inner sample until it ends on the border."""
        for _ in range(_BISECTIONS):
            middle = (outer + inner) / 2
            seen: BoolArray = inside_image(
                self.camera, self.observe(segments, middle[:, None])[:, 0]
            )
            inner, outer = np.where(seen, middle, inner), np.where(seen, outer, middle)
        return inner


def _bounds(camera: Camera, ideal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a rectangle of ideal px that holds all that the image shows."""
    known = ideal[all_finite(ideal, 1)]
    fold = float(getattr(camera.distortion, "fold_radius", np.inf))
    if len(known) < len(ideal) and np.isfinite(fold):
        # the image is wider than the lens model reaches: all up to where it turns back
        reach = fold * np.abs(camera.matrix_px[:2, :2]).sum(axis=1)
        known = np.concatenate([known, camera.matrix_px[:2, 2] + np.stack([-reach, reach])])
    low, high = known.min(axis=0), known.max(axis=0)
    if np.array_equal(high - low, camera.size_px):
        return low, high  # no lens: exactly the image
    # between samples of the border the lens bulges by less than one of their distances
    spare = (high - low) / (_BORDER - 1)
    return low - spare, high + spare


def _cut(
    near: FloatArray, far: FloatArray, offset: FloatArray | float, slope: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Keep the part of [near, far] on which offset + distance * slope >= 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = -offset / slope
    near = np.where(slope > 0, np.maximum(near, zero), near)
    far = np.where(slope < 0, np.minimum(far, zero), far)
    never = (slope == 0) & (np.asarray(offset) < 0)
    return np.where(never, np.inf, near), far
