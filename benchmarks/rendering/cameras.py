"""Pinhole cameras with Brown distortion, written apart from `closerange` so as to judge it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

CONVENTION = (
    "x_cam = R X_world + t (mm); OpenCV axes (x right, y down, z forward); OpenCV Brown distortion "
    "order k1,k2,p1,p2,k3 acting on normalised undistorted x,y; pixel (0,0) is the centre of the "
    "top-left pixel"
)
STEPS = 60  # of the inversion; each gains a digit or more with distortions of a few percent


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A camera in the world.

    Attributes
    ----------
    name : str
        Names its files.
    size_px : tuple of int
        Width and height.
    focal_px : float
        Of square pixels.
    principal_px : tuple of float
        Column and row.
    brown : tuple of float
        k1, k2, p1, p2, k3 as in OpenCV.
    rotation : ndarray, shape (3, 3)
        R of ``x_cam = R X + t``.
    translation_mm : ndarray, shape (3,)
        t of it.
    """

    name: str
    size_px: tuple[int, int]
    focal_px: float
    principal_px: tuple[float, float]
    brown: tuple[float, float, float, float, float]
    rotation: FloatArray
    translation_mm: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """Camera matrix, shape (3, 3), px."""
        (u, v), f = self.principal_px, self.focal_px
        return np.array([[f, 0, u], [0, f, v], [0, 0, 1]])

    @property
    def centre_mm(self) -> FloatArray:
        """Projection centre in the world, shape (3,)."""
        return np.asarray(-self.rotation.T @ self.translation_mm)

    def in_camera(self, xyz_mm: ArrayLike) -> FloatArray:
        """Carry world points, shape (..., 3), into the camera's frame."""
        return np.asarray(xyz_mm, np.float64) @ self.rotation.T + self.translation_mm

    def distorted_px(self, ideal: FloatArray) -> FloatArray:
        """Return the pixels, shape (N, 2), of undistorted normalised coordinates."""
        k1, k2, p1, p2, k3 = self.brown
        x, y = ideal[:, 0], ideal[:, 1]
        r2 = x * x + y * y
        g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * g + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * g + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.column_stack([xd, yd]) * self.focal_px + self.principal_px

    def ideal(self, xy_px: FloatArray) -> FloatArray:
        """Return the undistorted normalised coordinates, shape (N, 2), of pixels."""
        k1, k2, p1, p2, k3 = self.brown
        xd, yd = ((xy_px - self.principal_px) / self.focal_px).T
        x, y = xd, yd
        for _ in range(STEPS):
            r2 = x * x + y * y
            g = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
            new_x = (xd - 2 * p1 * x * y - p2 * (r2 + 2 * x * x)) / g
            new_y = (yd - p1 * (r2 + 2 * y * y) - 2 * p2 * x * y) / g
            moved = max(np.abs(new_x - x).max(initial=0), np.abs(new_y - y).max(initial=0))
            x, y = new_x, new_y
            if moved < 1e-15:
                break
        return np.column_stack([x, y])

    def project(self, xyz_mm: ArrayLike) -> FloatArray:
        """Return where world points, shape (N, 3), are seen, px, shape (N, 2)."""
        point = self.in_camera(xyz_mm)
        return self.distorted_px(point[:, :2] / point[:, 2:])

    def world(self, ideal: FloatArray, depth_mm: FloatArray) -> FloatArray:
        """Return the world points, shape (N, 3), at depths along undistorted rays."""
        ray = np.column_stack([ideal, np.ones(len(ideal))])
        return np.asarray((ray * depth_mm[:, None] - self.translation_mm) @ self.rotation)

    def inside(self, xy_px: FloatArray) -> NDArray[np.bool_]:
        """Tell which pixels, shape (N, 2), the image holds."""
        return np.asarray(((xy_px >= -0.5) & (xy_px < np.array(self.size_px) - 0.5)).all(axis=1))

    def document(self) -> Mapping[str, Any]:
        """Return the entry of ``cameras.json``."""
        return {
            "width": self.size_px[0],
            "height": self.size_px[1],
            "K": self.matrix.tolist(),
            "dist_k1_k2_p1_p2_k3": list(self.brown),
            "R": self.rotation.tolist(),
            "t_mm": self.translation_mm.tolist(),
            "centre_mm": self.centre_mm.tolist(),
        }


def looking(
    name: str,
    size_px: tuple[int, int],
    focal_px: float,
    *,
    centre_mm: tuple[float, float, float],
    target_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    roll_deg: float = 0.0,
    off_px: tuple[float, float] = (0.0, 0.0),
    brown: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0),
) -> View:
    """Build a camera that looks at a point.

    Parameters
    ----------
    name, size_px, focal_px, brown
        As in `View`.
    centre_mm, target_mm : tuple of float
        Projection centre and a point of the optical axis.
    roll_deg : float
        Turn about the optical axis; at 0 world +Y is up in the image.
    off_px : tuple of float
        Principal point from the middle of the image.

    Returns
    -------
    View
        The camera.
    """
    forward = np.subtract(target_mm, centre_mm)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    level = np.stack([right, np.cross(forward, right), forward])
    cos, sin = np.cos(np.deg2rad(roll_deg)), np.sin(np.deg2rad(roll_deg))
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ level
    middle = (size_px[0] - 1) / 2 + off_px[0], (size_px[1] - 1) / 2 + off_px[1]
    return View(name, size_px, focal_px, middle, brown, rotation, -rotation @ np.asarray(centre_mm))


def convergence(first: View, second: View) -> Mapping[str, float]:
    """Return angle (deg) and shortest distance (mm) of two optical axes."""
    one, other = first.rotation[2], second.rotation[2]
    normal = np.cross(one, other)
    between = second.centre_mm - first.centre_mm
    return {
        "angle_between_optical_axes_deg": float(np.rad2deg(np.arccos(one @ other))),
        "optical_axes_shortest_distance_mm": float(abs(between @ normal) / np.linalg.norm(normal)),
    }
