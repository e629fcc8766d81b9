"""Rays of pixels, cut at the walls of a volume."""

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
from closerange.rig.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class SightLines:
    """The part of each pixel's ray that lies inside a volume; N pixels.

    Attributes
    ----------
    centre_mm : ndarray, shape (3,)
        Projection centre from which all rays come.
    direction : ndarray, shape (N, 3)
        Unit vectors into the scene, world.
    near_mm, far_mm : ndarray, shape (N,)
        Distances along the ray, from the centre, at which it enters and leaves the volume; NaN
        where it does not meet it.
    flags : ndarray of int, shape (N,)
        Why not: `not_found` (no pixel), `not_converged` (beyond the lens model),
        `outside_volume` (the ray misses the volume, or leaves it only at infinity),
        `behind_camera` (the volume lies behind).
    """

    centre_mm: FloatArray
    direction: FloatArray
    near_mm: FloatArray
    far_mm: FloatArray
    flags: IntArray

    def __post_init__(self) -> None:
        count = len(self.flags)
        for name, shape in (
            ("centre_mm", (3,)),
            ("direction", (count, 3)),
            ("near_mm", (count,)),
            ("far_mm", (count,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), shape, name))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (count,), "flags"))

    def __len__(self) -> int:
        return len(self.flags)

    def at(self, distance_mm: ArrayLike) -> FloatArray:
        """Return world points on the rays.

        Parameters
        ----------
        distance_mm : array_like, shape (N,) or (N, K)
            Distances from the centre.

        Returns
        -------
        ndarray, shape (N, 3) or (N, K, 3)
            In mm.
        """
        distance = np.asarray(distance_mm, np.float64)
        direction = self.direction if distance.ndim == 1 else self.direction[:, None]
        return np.asarray(self.centre_mm + distance[..., None] * direction)


def between_planes(z_min_mm: float, z_max_mm: float) -> FloatArray:
    """Return the volume between two planes of constant Z, without limits in X and Y.

    Parameters
    ----------
    z_min_mm, z_max_mm : float
        The thesis' Z_upper and Z_lower, in any order of importance: the smaller comes first.

    Returns
    -------
    ndarray, shape (2, 3)
        For `sight_line` and `epipolar_segment`.

    Raises
    ------
    InputError
        If they are not finite or not in order.
    """
    if not np.isfinite([z_min_mm, z_max_mm]).all():
        raise InputError(
            f"Z from {z_min_mm} to {z_max_mm} mm is not finite", remedy="give two numbers"
        )
    unlimited = [np.inf, np.inf]
    return checked_volume([[-np.inf, -np.inf, z_min_mm], [*unlimited, z_max_mm]])


def checked_volume(volume_mm: ArrayLike) -> FloatArray:
    """Return a volume as an array, or say what is wrong with it.

    Parameters
    ----------
    volume_mm : array_like, shape (2, 3)
        Lower and upper corner; infinite on an axis without limits. A flat volume is allowed.

    Returns
    -------
    ndarray, shape (2, 3)
        The same numbers.

    Raises
    ------
    InputError
        If a lower limit exceeds the upper one, a limit is not a number or all are infinite.
    """
    volume = np.array(volume_mm, np.float64)
    if volume.shape != (2, 3):
        raise InputError(
            f"the volume has shape {volume.shape}, expected (2, 3)",
            remedy="give the lower corner X Y Z and the upper corner X Y Z",
        )
    ordered = volume[0] <= volume[1]  # false for NaN
    for axis in np.flatnonzero(~ordered):
        raise InputError(
            f"the volume's {'XYZ'[axis]} runs from {volume[0, axis]} to {volume[1, axis]} mm",
            remedy="give the lower limit first",
        )
    if not np.isfinite(volume).all(axis=0).any():
        raise InputError(
            "the volume has no axis with two limits", remedy="limit at least one axis, such as Z"
        )
    return volume


def inside_image(camera: Camera, xy_px: ArrayLike) -> BoolArray:
    """Tell which pixels lie in a camera's image.

    Parameters
    ----------
    camera : Camera
        Gives the size.
    xy_px : array_like, shape (..., 2)
        Observed px; the image ends half a pixel beyond the outer pixels' centres.

    Returns
    -------
    ndarray of bool, shape (...)
        False for NaN.
    """
    width, height = camera.size_px
    x, y = np.moveaxis(np.asarray(xy_px, np.float64), -1, 0)
    return np.asarray((x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5))


def sight_line(camera: Camera, xy_px: ArrayLike, volume_mm: ArrayLike) -> SightLines:
    """Cut the ray of each pixel at the walls of a box.

    Parameters
    ----------
    camera : Camera
        Anywhere, inside of the box too.
    xy_px : array_like, shape (N, 2)
        Observed px; whether they lie inside of the image is not asked.
    volume_mm : array_like, shape (2, 3)
        Lower and upper corner in the world; infinite on axes without limits.

    Returns
    -------
    SightLines
        NaN and a flag where the ray does not meet the box in front of the camera.

    Raises
    ------
    InputError
        If the volume is none.

    Notes
    -----
    Equation (5.2) with Z_upper and Z_lower is the special case of two planes. Each axis bounds
    the ray to an interval (a slab); the box is their intersection.
    """
    lower, upper = checked_volume(volume_mm)
    pixels = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
    direction = camera.directions(pixels)
    centre = camera.centre_mm
    known = all_finite(direction, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (lower - centre) / direction
        second = (upper - centre) / direction
    # a ray along a slab is inside of it for ever, or never
    along = direction == 0
    within = (lower <= centre) & (centre <= upper)
    first = np.where(along, np.where(within, -np.inf, np.inf), first)
    second = np.where(along, np.where(within, np.inf, -np.inf), second)
    enters = np.where(along, first, np.minimum(first, second)).max(axis=1, initial=-np.inf)
    leaves = np.where(along, second, np.maximum(first, second)).min(axis=1, initial=np.inf)
    behind = known & (enters <= leaves) & (leaves <= 0)
    misses = known & ~((enters <= leaves) & np.isfinite(leaves))
    flags = np.zeros(len(pixels), np.int64)
    flags[~known] = int(Flag.not_converged)
    flags[~all_finite(pixels, 1)] = int(Flag.not_found)
    flags[misses] = int(Flag.outside_volume)
    flags[behind] = int(Flag.behind_camera)
    met = flags == 0
    return SightLines(
        centre_mm=centre,
        direction=direction,
        near_mm=np.where(met, np.maximum(enters, 0.0), np.nan),
        far_mm=np.where(met, leaves, np.nan),
        flags=flags,
    )
