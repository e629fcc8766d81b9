"""What a calibration works on: image points joined with their known positions."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from closerange.errors import CloseRangeWarning, GeometryError, InputError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag, format_flags
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.camera import Camera
from closerange.rig.disc_bias import DiscViews, disc_centre_bias
from closerange.rig.dlt import MIN_POINTS
from closerange.rig.view import View

EXCLUDING = (
    Flag.not_found
    | Flag.at_border  # a part of the feature is missing: its centre is not where it seems
    | Flag.poor_fit
    | Flag.ambiguous
    | Flag.aperture
    | Flag.occluded
    | Flag.outlier
    | Flag.behind_camera
    | Flag.not_converged
)
"""Defects that displace a point: it is kept out of the fit. Blur and low contrast only make it
noisier, which its covariance says where there is one; the remaining bits concern positions."""

LISTED = 5  # names in a message before it says "and so many more"


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Image points with known positions; N rows.

    Attributes
    ----------
    points : ImagePoints
        The rows that have a known position in the world and a position in the image.
    size_px : dict of str to (int, int)
        Image size of each camera, in the order of the tables.
    camera : ndarray of int, shape (N,)
        Index into `size_px`.
    control_row : ndarray of int, shape (N,)
        Row of the control table.
    xyz_mm : ndarray, shape (N, 3)
        Known positions.
    std_mm : ndarray, shape (N,)
        Their standard deviations.
    usable : ndarray of bool, shape (N,)
        May take part in the fit: no check point, no excluding flag.
    """

    points: ImagePoints
    size_px: dict[str, tuple[int, int]]
    camera: IntArray
    control_row: IntArray
    xyz_mm: FloatArray
    std_mm: FloatArray
    usable: BoolArray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Camera names."""
        return tuple(self.size_px)

    def select(self, rows: BoolArray) -> Observations:
        """Keep some rows; no camera is dropped."""
        return Observations(
            points=self.points.select(rows),
            size_px=self.size_px,
            camera=self.camera[rows],
            control_row=self.control_row[rows],
            xyz_mm=self.xyz_mm[rows],
            std_mm=self.std_mm[rows],
            usable=self.usable[rows],
        )

    def rows(self, camera: int) -> IntArray:
        """Return the usable rows of a camera."""
        return np.flatnonzero(self.usable & (self.camera == camera)).astype(np.int64)

    def stated_cov(self, camera: int) -> FloatArray:
        """Return the covariances of the usable rows of a camera, shape (n, 2, 2).

        A row without one gets the median variance of its camera, or of all cameras where its own
        states none: a gap must not undo what is known of the other points. Zeros where no row of
        any camera has one.
        """
        variance = np.trace(self.points.cov_px2, axis1=1, axis2=2) / 2
        known = np.isfinite(variance) & self.usable
        own = known & (self.camera == camera)
        cov = self.points.cov_px2[self.rows(camera)].copy()
        gaps = ~np.isfinite(cov).all(axis=(1, 2))
        typical = np.median(variance[own if own.any() else known]) if known.any() else 0.0
        cov[gaps] = typical * np.eye(2)
        return cov

    def view(self, camera: int, xy_px: FloatArray) -> View:
        """Return the usable rows of a camera, with given image positions of all N rows."""
        rows, name = self.rows(camera), self.cameras[camera]
        return View(name, self.size_px[name], self.xyz_mm[rows], xy_px[rows])


def join(
    points: ImagePoints, control: ControlPoints, size_px: Mapping[str, tuple[int, int]]
) -> Observations:
    """Join image points with their known positions, and refuse what cannot be calibrated.

    Parameters
    ----------
    points : ImagePoints
        Of all cameras and placements.
    control : ControlPoints
        Known positions; those never seen do no harm.
    size_px : mapping of str to (int, int)
        Image width and height of each camera.

    Returns
    -------
    Observations
        Joined rows.

    Raises
    ------
    InputError
        If an image size is missing or points lie outside of it.
    GeometryError
        If a camera has fewer than six usable control points.

    Warns
    -----
    CloseRangeWarning
        Of image points without control, and of cameras with an image size but no points.
    """
    if not len(points):
        raise InputError("the points table has no rows", remedy="detect the target first")
    _warn_of_silent_cameras(points, size_px)
    sizes = {name: _size_of(name, size_px) for name in points.cameras}
    row = control.rows_of(points)
    _warn_of_strangers(points, row < 0)
    joined = (row >= 0) & points.found
    row, points = row[joined], points.select(joined)
    index = {name: i for i, name in enumerate(sizes)}
    camera = np.array([index[name] for name in points.camera], dtype=np.int64)
    xyz = control.xyz_mm[row]
    _require_inside(points, xyz, sizes)
    observations = Observations(
        points=points,
        size_px=sizes,
        camera=camera,
        control_row=row,
        xyz_mm=xyz,
        std_mm=control.std_mm[row],
        usable=_usable(points, control.check[row], camera),
    )
    _require_enough(observations)
    return observations


def without_disc_bias(observations: Observations, cameras: Sequence[Camera]) -> FloatArray:
    """Return where the centres of discs would be seen, instead of the centres of their images.

    Parameters
    ----------
    observations : Observations
        Rows; those with an ellipse in two cameras are corrected.
    cameras : sequence of Camera
        Calibrated well enough to tell the attitude of discs, in the order of the observations.

    Returns
    -------
    ndarray, shape (N, 2)
        Image positions in px; see `disc_bias`.
    """
    points = observations.points
    keys = list(zip(points.placement, points.reading, points.point, strict=True))
    index = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    disc = np.array([index[key] for key in keys], dtype=np.int64)
    xyz = np.zeros((len(index), 3))
    ellipse = np.full((len(index), len(cameras), 3), np.nan)
    diameter = np.full(len(index), np.nan)
    xyz[disc] = observations.xyz_mm
    ellipse[disc, observations.camera] = points.ellipse
    diameter[disc] = points.disc_diameter_mm
    bias = disc_centre_bias(cameras, DiscViews(xyz, ellipse, diameter))
    corrected: FloatArray = points.xy_px - bias[disc, observations.camera]
    return corrected


def listed(names: Sequence[str]) -> str:
    """Write names, the first few of many."""
    unique = list(dict.fromkeys(names))
    more = f" and {len(unique) - LISTED} more" if len(unique) > LISTED else ""
    return ", ".join(repr(name) for name in unique[:LISTED]) + more


def _size_of(name: str, size_px: Mapping[str, tuple[int, int]]) -> tuple[int, int]:
    if name not in size_px:
        known = f"known are {listed(list(size_px))}" if size_px else "none is known"
        raise InputError(
            f"the image size of camera {name!r} is not known ({known})",
            remedy=f"add --image-size {name}=WIDTHxHEIGHT, or size_px in Python",
        )
    width, height = size_px[name]
    if width < 1 or height < 1:
        raise InputError(
            f"camera {name!r}: an image of {width}x{height} px is empty",
            remedy="give width and height in px, both at least 1",
        )
    return int(width), int(height)


def _warn_of_silent_cameras(points: ImagePoints, size_px: Mapping[str, tuple[int, int]]) -> None:
    silent = [name for name in size_px if name not in points.cameras]
    if silent:
        warnings.warn(
            f"camera {listed(silent)} has an image size but no image points: it is left out",
            CloseRangeWarning,
            stacklevel=4,
        )


def _warn_of_strangers(points: ImagePoints, unknown: BoolArray) -> None:
    rows = np.flatnonzero(unknown)
    if len(rows):
        names = listed([points.point[i] for i in rows])
        placements = listed([points.placement[i] for i in rows])
        warnings.warn(
            f"{len(rows)} of {len(points)} image points have no control row and are left out: "
            f"points {names}; placements {placements}",
            CloseRangeWarning,
            stacklevel=4,
        )


def _require_inside(
    points: ImagePoints, xyz_mm: FloatArray, size_px: Mapping[str, tuple[int, int]]
) -> None:
    size = np.array([size_px[name] for name in points.camera]).reshape(-1, 2)
    outside = _beyond(points.xy_px, size)
    if not outside.any():
        return
    row = int(np.flatnonzero(outside)[0])
    if not _beyond(xyz_mm[:, :2], size).any():
        remedy = (
            "the control's x_mm and y_mm would fit into the image: "
            "are the mm and px columns exchanged?"
        )
    elif not _beyond(points.xy_px, size[:, ::-1]).any():
        remedy = "with width and height exchanged all points lie inside: write WIDTHxHEIGHT"
    else:
        remedy = "state the full image's size; of crops, add the offset to x_px, y_px"
    x, y = points.xy_px[row]
    raise InputError(
        f"{np.count_nonzero(outside)} of {len(points)} image points lie outside of the image, the "
        f"first is {points.point[row]!r} of camera {points.camera[row]!r} at ({x:.1f}, {y:.1f}) in "
        f"{size[row, 0]}x{size[row, 1]} px",
        remedy=remedy,
    )


def _beyond(xy: FloatArray, size: IntArray) -> BoolArray:
    return np.asarray(((xy < -0.5) | (xy > size - 0.5)).any(axis=1))


def _usable(points: ImagePoints, check: BoolArray, camera: IntArray) -> BoolArray:
    """Leave out check points and defects; saturated discs only while enough others remain."""
    usable: BoolArray = np.asarray(~check & ((points.flags & int(EXCLUDING)) == 0))
    saturated = usable & ((points.flags & int(Flag.saturated)) != 0)
    for index in np.unique(camera[saturated]):
        mine = usable & (camera == index)
        if 2 * np.count_nonzero(saturated & mine) <= np.count_nonzero(mine):
            usable = usable & ~(saturated & mine)
            continue
        name = points.camera[int(np.flatnonzero(mine)[0])]
        warnings.warn(
            f"camera {name!r}: {np.count_nonzero(saturated & mine)} of {np.count_nonzero(mine)} "
            "points are saturated, too many to leave out: expose shorter",
            CloseRangeWarning,
            stacklevel=5,
        )
    return usable


def _require_enough(observations: Observations) -> None:
    for index, name in enumerate(observations.cameras):
        known = len(np.unique(observations.control_row[observations.rows(index)]))
        if known >= MIN_POINTS:
            continue
        mine = observations.camera == index
        flags = [
            format_flags(int(flag & int(EXCLUDING | Flag.saturated)))
            for flag in observations.points.flags[mine & ~observations.usable]
        ]
        reasons = [f"{flags.count(flag)} {flag or 'check points'}" for flag in dict.fromkeys(flags)]
        raise GeometryError(
            f"camera {name!r}: {known} different control points are usable, the limit is "
            f"{MIN_POINTS}" + (f" (left out: {', '.join(reasons)})" if reasons else ""),
            remedy="add placements, or check that points and control name them alike",
        )
