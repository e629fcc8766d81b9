"""Radial distortion as a table of the radius (section 6.2 of the thesis).

It states delta_r, by which an observed point lies too far out; it is SUBTRACTED, eq. (6.2):
x_c = x (1 - delta_r / r). The corrections (6.5) of `BrownObserved` are ADDED: signs differ.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from closerange.errors import GeometryError, InputError
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownObserved, Distortion


@dataclass(frozen=True, slots=True, eq=False)
class RadialTable:
    """Radial distortion delta_r at observed radii.

    Between rows it is interpolated by a monotone cubic (Fritsch and Carlson, 1980,
    doi:10.1137/0717021), which has no waves of its own between measured rows. Beyond the last
    row it is unknown: NaN.

    Attributes
    ----------
    radius_px : ndarray, shape (M,)
        Observed radii from the principal point, rising from 0.
    delta_px : ndarray, shape (M,)
        Outward displacement; 0 in the first row.

    Raises
    ------
    InputError
        If radii do not rise from 0, a number is not finite, or delta_r is not 0 at the centre.
    """

    radius_px: FloatArray
    delta_px: FloatArray

    def __post_init__(self) -> None:
        radius = frozen_array(self.radius_px, (None,), "radius_px")
        delta = frozen_array(self.delta_px, (len(radius),), "delta_px")
        if not (np.isfinite(radius).all() and np.isfinite(delta).all()):
            raise InputError("the radial table has numbers that are not finite", remedy="fill them")
        if len(radius) < 2 or radius[0] != 0 or delta[0] != 0 or not (np.diff(radius) > 0).all():
            raise InputError(
                "a radial table needs at least two rows, radii that rise, and 0, 0 in the first",
                remedy="begin with the row 0, 0 and sort by radius",
            )
        object.__setattr__(self, "radius_px", radius)
        object.__setattr__(self, "delta_px", delta)

    def delta(self, radius_px: ArrayLike) -> FloatArray:
        """Interpolate delta_r.

        Parameters
        ----------
        radius_px : array_like
            Observed radii.

        Returns
        -------
        ndarray
            delta_r in px, of the same shape; NaN beyond the table.
        """
        curve = PchipInterpolator(self.radius_px, self.delta_px, extrapolate=False)
        interpolated: FloatArray = curve(np.asarray(radius_px, np.float64))
        return interpolated

    def correct(self, xy_px: ArrayLike, centre_px: ArrayLike) -> FloatArray:
        """Remove radial distortion, eq. (6.2).

        Parameters
        ----------
        xy_px : array_like, shape (N, 2)
            Observed px.
        centre_px : array_like, shape (2,)
            Principal point, px.

        Returns
        -------
        ndarray, shape (N, 2)
            Corrected px; NaN beyond the table.
        """
        centre = np.asarray(centre_px, np.float64)
        offset = np.reshape(np.asarray(xy_px, np.float64), (-1, 2)) - centre
        radius = np.hypot(offset[:, 0], offset[:, 1])
        ratio = self.delta(radius) / np.where(radius > 0, radius, 1.0)  # 0 at the centre
        corrected: FloatArray = centre + offset * (1 - ratio)[:, None]
        return corrected


def radial_table_of(camera: Camera, *, rows: int = 65) -> RadialTable:
    """Tabulate the radial distortion of a camera's lens, from the centre to the farthest corner.

    Parameters
    ----------
    camera : Camera
        Tangential terms are left out. Radii are along a scale of sqrt(fx fy).
    rows : int, optional
        Number of rows, at least two.

    Returns
    -------
    RadialTable
        Shorter where the lens model ends before the corner.

    Raises
    ------
    InputError
        If `rows` is below two.
    GeometryError
        If the lens model holds nowhere but at the centre.
    """
    if rows < 2:
        raise InputError(f"{rows} rows, a table needs at least 2", remedy="ask for more rows")
    centre = lens_centre(camera)
    width, height = camera.size_px
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]])
    reach = float(np.linalg.norm(corners - centre, axis=1).max())
    radius = np.linspace(0, reach, rows)
    delta = radius - _ideal_radius(camera, radius)
    # rows up to the first at which no ideal point exists
    known = int(np.count_nonzero(np.logical_and.accumulate(np.isfinite(delta))))
    if known < 2:
        raise GeometryError(
            "the lens model holds nowhere but at its centre", remedy="calibrate the lens again"
        )
    delta[0] = 0.0
    return RadialTable(radius[:known], delta[:known])


def radial_tables(cameras: Iterable[Camera], *, rows: int = 65) -> dict[str, RadialTable]:
    """Tabulate the radial distortion of all lenses that have one.

    Parameters
    ----------
    cameras : iterable of Camera
        Those of one rig.
    rows : int, optional
        As in `radial_table_of`.

    Returns
    -------
    dict of str to RadialTable
        By the camera's name; without lenses that do not distort or hold at their centre only.
    """
    found = {}
    for camera in cameras:
        try:
            table = radial_table_of(camera, rows=rows)
        except GeometryError:
            continue
        if table.delta_px.any():
            found[camera.name] = table
    return found


def lens_centre(camera: Camera) -> FloatArray:
    """Return the px about which a camera's radial distortion is symmetric, shape (2,)."""
    if isinstance(camera.distortion, BrownObserved):
        return camera.distortion.centre_px
    return camera.matrix_px[:2, 2]


def _ideal_radius(camera: Camera, radius_px: FloatArray) -> FloatArray:
    """Undistort observed radii with the radial terms alone."""
    lens = camera.distortion
    if isinstance(lens, BrownObserved):
        unit = float(np.sqrt(np.prod(lens.unit_px)))
        return radius_px - unit * lens.radial_curve(radius_px / unit)
    focal = float(np.sqrt(camera.matrix_px[0, 0] * camera.matrix_px[1, 1]))
    radial: Distortion = lens.moved(**{term: -camera.parameter(term) for term in ("p1", "p2")})
    on_axis = np.column_stack([radius_px, np.zeros(len(radius_px))])
    return radial.undistort(on_axis, np.diag([focal, focal, 1.0]))[:, 0]
