"""The pencil of epipolar planes of two cameras: coordinates that make a match one number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.errors import InputError
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import Camera

AT_ONCE = 16_000
"""Rays that are worked on at once. Of more, the products with small matrices are shared out
between processors, which takes longer than the products where others work too."""


@dataclass(frozen=True, slots=True, eq=False)
class Pencil:
    """All planes through the two projection centres.

    A ray lies in the plane at angle ``theta`` about the line between the centres and leaves it at
    a slope ``q`` (way along that line per way across it). Rays of two cameras meet only if their
    theta is equal, and the distance from the line then follows from the two slopes alone. This
    is what rectification is for; it needs no image to be warped, and holds for cameras anywhere,
    also with an epipole inside the image, and with distorting lenses.

    Attributes
    ----------
    first, second : Camera
        The two cameras.
    axes : ndarray, shape (3, 3)
        Rows: unit vector from the first centre to the second, and two across it; the first of
        those points where the cameras look.
    baseline_mm : float
        Distance between the centres.
    """

    first: Camera
    second: Camera
    axes: FloatArray
    baseline_mm: float

    @classmethod
    def of(cls, first: Camera, second: Camera) -> Pencil:
        """Build the pencil of two cameras.

        Raises
        ------
        InputError
            If both look from the same place.
        """
        along = second.centre_mm - first.centre_mm
        baseline = float(np.linalg.norm(along))
        forward = first.camera_from_world.rotation[2] + second.camera_from_world.rotation[2]
        scale = max(float(np.abs(first.centre_mm).max()), 1.0)
        if baseline < 1e-9 * scale:
            raise InputError(
                f"cameras {first.name!r} and {second.name!r} are {baseline:.3g} mm apart: from one "
                "place there is no depth",
                remedy="match the images of cameras that stand apart",
            )
        along = along / baseline
        across = forward - along * (forward @ along)
        if np.linalg.norm(across) < 1e-6:  # both look along the line: any direction across will do
            across = np.eye(3)[np.argmin(np.abs(along))]
            across = across - along * (across @ along)
        across /= np.linalg.norm(across)
        return cls(first, second, np.stack([along, across, np.cross(along, across)]), baseline)

    def reversed(self) -> Pencil:
        """Return the pencil seen from the second camera: theta and slopes change sign."""
        return Pencil(
            self.second, self.first, self.axes * [[-1.0], [1.0], [-1.0]], self.baseline_mm
        )

    def coordinates(self, camera: Camera, xy_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return theta (rad) and slope of the rays of pixels, shape (N,) each."""
        theta, slope = np.empty(len(xy_px)), np.empty(len(xy_px))
        for start in range(0, len(xy_px), AT_ONCE):
            some = slice(start, start + AT_ONCE)
            along, across, upwards = (camera.directions(xy_px[some]) @ self.axes.T).T
            theta[some] = np.arctan2(upwards, across)
            slope[some] = along / np.hypot(across, upwards)
        return theta, slope

    def point(self, theta: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return where rays of one theta meet, shape (N, 3), world mm.

        Parameters
        ----------
        theta : ndarray, shape (N,)
            Angle of the plane, rad.
        first, second : ndarray, shape (N,)
            Slopes of the ray of the first and of the second camera; NaN comes out where the rays
            part (first <= second).
        """
        closing = np.where(first > second, first - second, np.nan)
        distance = self.baseline_mm / closing
        way = np.column_stack([first, np.cos(theta), np.sin(theta)]) * distance[:, None]
        point: FloatArray = self.first.centre_mm + way @ self.axes
        return point
