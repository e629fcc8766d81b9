"""Image points arranged for triangulation: one row a world point, one column a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.errors import InputError
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.rig.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """M world points in the C cameras of a rig.

    Attributes
    ----------
    placement, reading, point : tuple of str
        Names of the M points, in the order of their first row.
    xy_px : ndarray, shape (M, C, 2)
        Observed px; NaN where not seen, or where the lens model has no answer.
    cov_px2 : ndarray, shape (M, C, 2, 2)
        C + tau^2 I: what was stated and what the calibration found that such statements leave
        out; s^2 I of the rig where nothing was stated.
    noise_cov_px2 : ndarray, shape (M, C, 2, 2)
        The part that differs between readings; NaN where it was not given.
    used : ndarray of bool, shape (M, C)
        Which views take part.
    flags : ndarray of int, shape (M,)
        Union of the flags of the views that take part, or of all where there are too few.
    ellipse : ndarray, shape (M, C, 3)
        Image ellipses; NaN where none.
    diameter_mm : ndarray, shape (M,)
        True disc diameters; NaN where none.
    own_cov : bool
        Whether every view that takes part came with a covariance.
    """

    placement: tuple[str, ...]
    reading: tuple[str, ...]
    point: tuple[str, ...]
    xy_px: FloatArray
    cov_px2: FloatArray
    noise_cov_px2: FloatArray
    used: BoolArray
    flags: IntArray
    ellipse: FloatArray
    diameter_mm: FloatArray
    own_cov: bool


def arrange(rig: Rig, points: ImagePoints) -> Observed:
    """Arrange image points by world point and camera.

    Flagged views are left out of a point that at least two unflagged ones see; otherwise they
    take part and the position carries their flags. A view that the lens model cannot undistort
    tells no direction: it is left out and the position says so.

    Parameters
    ----------
    rig : Rig
        Gives the cameras and the noise of points without a covariance.
    points : ImagePoints
        Rows of any order.

    Returns
    -------
    Observed
        M distinct (placement, reading, point).

    Raises
    ------
    InputError
        If a camera is not in the rig or its images have another size.
    """
    names = [camera.name for camera in rig.cameras]
    _check_cameras(rig, points)
    keys = list(dict.fromkeys(zip(points.placement, points.reading, points.point, strict=True)))
    row_of = {key: row for row, key in enumerate(keys)}
    rows = np.array(
        [row_of[key] for key in zip(points.placement, points.reading, points.point, strict=True)],
        dtype=np.intp,
    )
    columns = np.array([names.index(camera) for camera in points.camera], dtype=np.intp)
    shape = (len(keys), len(names))

    def table(values: FloatArray, *tail: int) -> FloatArray:
        filled = np.full((*shape, *tail), np.nan)
        filled[rows, columns] = values
        return filled

    flags = np.zeros(shape, dtype=np.int64)
    flags[rows, columns] = points.flags
    xy = table(points.xy_px, 2)
    found = all_finite(xy, 2)
    beyond = found & ~_undistorted(rig, xy)
    xy[beyond] = np.nan
    used = _used(found & ~beyond, flags)
    cov = table(points.cov_px2, 2, 2)
    unknown = ~all_finite(cov, (2, 3))
    cov += rig.tau_px**2 * np.eye(2)
    cov[unknown] = rig.noise_px**2 * np.eye(2)
    missed = beyond & (flags == 0)  # would have taken part
    flags[beyond] |= int(Flag.beyond_lens)
    carried = np.where(used | missed | (used.sum(axis=1) < 2)[:, None], flags, 0)
    diameters = table(points.disc_diameter_mm)
    known = np.isfinite(diameters)
    return Observed(
        placement=tuple(key[0] for key in keys),
        reading=tuple(key[1] for key in keys),
        point=tuple(key[2] for key in keys),
        xy_px=xy,
        cov_px2=cov,
        noise_cov_px2=table(points.noise_cov_px2, 2, 2),
        used=used,
        flags=np.bitwise_or.reduce(carried, axis=1) if keys else np.zeros(0, np.int64),
        ellipse=table(points.ellipse, 3),
        diameter_mm=np.where(
            known.any(axis=1), np.where(known, diameters, -np.inf).max(axis=1, initial=-1.0), np.nan
        ),
        own_cov=bool(used.any() and not (unknown & used).any()),
    )


def _undistorted(rig: Rig, xy_px: FloatArray) -> BoolArray:
    """Tell which views the lens models can undistort, shape (M, C)."""
    ideal = [camera.undistort(xy_px[:, i]) for i, camera in enumerate(rig.cameras)]
    return all_finite(np.stack(ideal, axis=1), 2)


def _used(found: BoolArray, flags: IntArray) -> BoolArray:
    clean = found & (flags == 0)
    enough = clean.sum(axis=1) >= 2
    used: BoolArray = np.where(enough[:, None], clean, found)
    return used


def _check_cameras(rig: Rig, points: ImagePoints) -> None:
    for name in points.cameras:
        camera = rig.camera(name)
        size = points.size_px.get(name, camera.size_px)
        if size != camera.size_px:
            raise InputError(
                f"camera {name!r}: images of {size[0]}x{size[1]} px, calibrated with "
                f"{camera.size_px[0]}x{camera.size_px[1]} px",
                remedy="use images of the calibrated size, or calibrate again",
            )
        _check_inside(points.of_camera(name), camera.size_px)


def _check_inside(points: ImagePoints, size_px: tuple[int, int]) -> None:
    """Refuse points that cannot come from images of this size, unless they say so themselves."""
    xy = points.xy_px
    admitted = (points.flags & int(Flag.outside_image)) != 0
    outside = points.found & ~admitted & ((xy < -0.5) | (xy > np.array(size_px) - 0.5)).any(axis=1)
    if outside.any():
        row = int(np.flatnonzero(outside)[0])
        raise InputError(
            f"camera {points.camera[row]!r}, point {points.point[row]!r}: ({xy[row, 0]:.1f}, "
            f"{xy[row, 1]:.1f}) px lies outside of its {size_px[0]}x{size_px[1]} px image",
            remedy="check that the table belongs to this camera and that the columns are px",
        )
