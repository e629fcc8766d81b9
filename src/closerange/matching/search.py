"""Where to search for a point of one view in another: epipolar segments, mapping by a plane.

Sections 5.4 and 5.5 of the thesis. There the object lies between two depths; here in any box of
the world, the cameras stand anywhere, and the lens bends the segment into a curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.geometry.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    all_finite,
    frozen_array,
    frozen_ints,
)
from closerange.matching.segment_clipping import SecondView
from closerange.matching.sight import (
    SightLines,
    between_planes,
    checked_volume,
    inside_image,
    sight_line,
)
from closerange.rig.camera import Camera

__all__ = [
    "EpipolarSegments",
    "PlaneMapping",
    "SightLines",
    "between_planes",
    "checked_volume",
    "epipolar_segment",
    "inside_image",
    "plane_mapping",
    "sight_line",
    "upper_plane_mapping",
]


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarSegments:
    """Where points of one view may lie in another, as sampled curves; N points.

    Samples run from near to far along the ray of the first camera; the first and the last are
    the exact ends, in the volume or on the border of the image.

    Attributes
    ----------
    lines : SightLines
        The rays whose images they are.
    xy_px : ndarray, shape (N, K, 2)
        Samples in the second view, observed px; NaN after the last of each curve.
    distance_mm : ndarray, shape (N, K)
        Where on the ray each sample lies; NaN likewise.
    count : ndarray of int, shape (N,)
        Samples of each curve; 0 where there is none.
    flags : ndarray of int, shape (N,)
        Why there is none: those of `SightLines`, or `behind_camera` or `outside_image` of the
        second view. `near_parallel` marks a segment that is a point, the two rays being one.
    """

    lines: SightLines
    xy_px: FloatArray
    distance_mm: FloatArray
    count: IntArray
    flags: IntArray

    def __post_init__(self) -> None:
        rows, width = self.distance_mm.shape
        if self.xy_px.shape != (rows, width, 2) or len(self.lines) != rows:
            raise ValueError("columns of segments differ in length")
        for array in (self.xy_px, self.distance_mm):
            array.flags.writeable = False  # large and made for this object: not copied
        object.__setattr__(self, "count", frozen_ints(self.count, (rows,), "count"))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (rows,), "flags"))

    def __len__(self) -> int:
        return len(self.count)

    @property
    def xyz_mm(self) -> FloatArray:
        """World points of the samples, shape (N, K, 3); computed anew at each call."""
        return self.lines.at(self.distance_mm)

    @property
    def valid(self) -> BoolArray:
        """Which samples exist, shape (N, K)."""
        return np.asarray(np.arange(self.distance_mm.shape[1]) < self.count[:, None])

    @property
    def length_px(self) -> FloatArray:
        """Length of each curve along its samples, shape (N,); 0 where there is none."""
        steps = np.linalg.norm(np.diff(self.xy_px, axis=1), axis=2)
        return np.asarray(np.nansum(steps, axis=1))


def epipolar_segment(
    camera_1: Camera,
    camera_2: Camera,
    xy_px: ArrayLike,
    volume_mm: ArrayLike,
    *,
    step_px: float = 1.0,
) -> EpipolarSegments:
    """Find where points of view 1 may lie in view 2.

    Parameters
    ----------
    camera_1, camera_2 : Camera
        Views; any lens, any attitude.
    xy_px : array_like, shape (N, 2)
        Observed px in view 1.
    volume_mm : array_like, shape (2, 3)
        Where the points may be in the world; see `sight_line` and `between_planes`.
    step_px : float, optional
        Largest distance between two samples of a curve.

    Returns
    -------
    EpipolarSegments
        Curves clipped to the image of view 2 and to what lies in front of it. Where a strong
        lens makes a curve leave the image and come back, the samples outside are left out. A
        curve that crosses a corner of the image within less than a step counts as outside.

    Raises
    ------
    InputError
        If the volume is none, or the step is not above zero.

    Notes
    -----
    Equations (5.2) and (5.3) of the thesis; without distortion the curve is the straight line
    between its ends. A sample takes 24 bytes, three times as much while it is made: cut very many
    points into pieces.
    """
    if not (np.isfinite(step_px) and step_px > 0):
        raise InputError(f"a step of {step_px} px", remedy="give a number above zero, such as 1")
    lines = sight_line(camera_1, xy_px, volume_mm)
    view = SecondView(camera_2)
    segments = view.clip(lines)
    fraction, observed = view.clip_samples(segments, view.fractions(segments, step_px))
    kept = np.isfinite(fraction)
    count = kept.sum(axis=1)
    if (kept[:, 1:] & ~kept[:, :-1]).any():
        # a stable sort moves what is left to the front of each row
        order = np.argsort(~kept, axis=1, kind="stable")
        fraction = np.take_along_axis(fraction, order, axis=1)
        observed = np.take_along_axis(observed, order[:, :, None], axis=1)
    width = max(int(count.max(initial=0)), 1)
    fraction, observed = fraction[:, :width], observed[:, :width]
    flags = lines.flags | segments.flags
    nothing = (count == 0) & ((flags & ~int(Flag.near_parallel)) == 0)
    flags = np.where(nothing, flags | int(Flag.outside_image), flags)
    return EpipolarSegments(
        lines,
        observed,
        segments.distance_mm(fraction),
        np.asarray(count, np.int64),
        np.asarray(flags, np.int64),
    )


@dataclass(frozen=True, slots=True, eq=False)
class PlaneMapping:
    """Pixels of one view carried through a plane of the world into another; N pixels.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Observed px in the second view, which may lie outside of its image; NaN where the ray
        does not meet the plane in front of both cameras or a lens model does not reach.
    xyz_mm : ndarray, shape (N, 3)
        Where the ray meets the plane; NaN likewise.
    jacobian : ndarray, shape (N, 2, 2)
        d px of view 2 / d px of view 1 along the plane: how the neighbourhood is warped.
    """

    xy_px: FloatArray
    xyz_mm: FloatArray
    jacobian: FloatArray

    def __post_init__(self) -> None:
        count = len(self.xy_px)
        for name, tail in (("xy_px", (2,)), ("xyz_mm", (3,)), ("jacobian", (2, 2))):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count, *tail), name))


def upper_plane_mapping(
    camera_1: Camera, camera_2: Camera, xy_px: ArrayLike, z_mm: ArrayLike
) -> PlaneMapping:
    """Carry pixels of view 1 through a plane of constant Z into view 2.

    Parameters
    ----------
    camera_1, camera_2 : Camera
        Views; any lens, any attitude.
    xy_px : array_like, shape (N, 2)
        Observed px in view 1.
    z_mm : float or array_like, shape (N,)
        World Z of the plane. The thesis takes Z_upper, the one farthest from the cameras.

    Returns
    -------
    PlaneMapping
        NaN where the way is barred.

    Notes
    -----
    Equations (5.4) and (5.3) of the thesis.
    """
    return plane_mapping(camera_1, camera_2, xy_px, normal=(0.0, 0.0, 1.0), offset_mm=z_mm)


def plane_mapping(
    camera_1: Camera,
    camera_2: Camera,
    xy_px: ArrayLike,
    *,
    normal: ArrayLike,
    offset_mm: ArrayLike,
) -> PlaneMapping:
    """Carry pixels of view 1 through planes of any slant into view 2.

    Parameters
    ----------
    camera_1, camera_2 : Camera
        Views; any lens, any attitude.
    xy_px : array_like, shape (N, 2)
        Observed px in view 1.
    normal : array_like, shape (3,) or (N, 3)
        Normal n of the plane, of any length but zero, or one for each pixel.
    offset_mm : float or array_like, shape (N,)
        The plane is ``n . X = offset``, X in mm.

    Returns
    -------
    PlaneMapping
        NaN where the way is barred.
    """
    pixels = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
    across = np.broadcast_to(np.asarray(normal, np.float64), (len(pixels), 3))
    offset = np.broadcast_to(np.asarray(offset_mm, np.float64), (len(pixels),))
    direction, centre = camera_1.directions(pixels), camera_1.centre_mm
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset - across @ centre) / np.sum(across * direction, axis=1)
    distance = np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)
    xyz = centre + distance[:, None] * direction
    xy = camera_2.project(xyz)
    known = all_finite(xy, 1)
    xyz, xy = np.where(known[:, None], xyz, np.nan), np.where(known[:, None], xy, np.nan)
    jacobian = np.full((len(pixels), 2, 2), np.nan)
    along = _basis(across[known])
    first = camera_1.project_jacobian(xyz[known]) @ along
    second = camera_2.project_jacobian(xyz[known]) @ along
    jacobian[known] = second @ _inverse(first)
    return PlaneMapping(xy, xyz, jacobian)


def _basis(normal: FloatArray) -> FloatArray:
    """Return two directions in each plane, as columns, shape (N, 3, 2)."""
    # crossing with the axis that is least along the normal loses no digits
    axis = np.eye(3)[np.argmin(np.abs(normal), axis=1)]
    first = np.cross(normal, axis)
    return np.stack([first, np.cross(normal, first)], axis=2)


def _inverse(matrix: FloatArray) -> FloatArray:
    """Invert 2 x 2 matrices; NaN where singular, as for a plane seen edge-on."""
    a, b, c, d = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1]
    determinant = a * d - b * c
    determinant = np.where(determinant != 0, determinant, np.nan)
    adjoint = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray(adjoint / determinant[:, None, None])
