"""The error that a rig predicts for itself, anywhere in its volume."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray, frozen_array
from closerange.position.triangulate import solve_points
from closerange.rig.rig import Rig

NODES = 7
"""Nodes along each side of the volume: errors are smooth, quadratic at most."""

THIN = 0.25
"""A side shorter than this part of the longest one is widened before the volume is judged."""


@dataclass(frozen=True, slots=True, eq=False)
class ErrorMap:
    """Predicted standard deviations of one position on a regular grid; M nodes.

    Attributes
    ----------
    xyz_mm : ndarray, shape (M, 3)
        Nodes, in C order over (x, y, z).
    shape : tuple of int
        Number of nodes along x, y and z.
    std_mm : ndarray, shape (M, 3)
        Total standard deviation of X, Y, Z; NaN where fewer than two cameras see the node.
    calibration_std_mm : ndarray, shape (M, 3)
        The part that comes from the calibration.
    """

    xyz_mm: FloatArray
    shape: tuple[int, int, int]
    std_mm: FloatArray
    calibration_std_mm: FloatArray

    def __post_init__(self) -> None:
        count = int(np.prod(self.shape))
        for name in ("xyz_mm", "std_mm", "calibration_std_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count, 3), name))


def predict_errors(
    rig: Rig, volume_mm: FloatArray | None = None, *, nodes: int = NODES
) -> ErrorMap:
    """Predict the standard deviation of a position all over a volume.

    Parameters
    ----------
    rig : Rig
        Cameras with the covariance of their parameters and the image noise.
    volume_mm : ndarray, shape (2, 3), optional
        Lower and upper corner; the rig's own volume by default.
    nodes : int, optional
        Nodes along each side.

    Returns
    -------
    ErrorMap
        Values for one reading with the image noise of the calibration.
    """
    lower, upper = rig.volume_mm if volume_mm is None else volume_mm
    axes = [np.linspace(lower[i], upper[i], nodes) for i in range(3)]
    xyz = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    pixels = np.stack([camera.project(xyz) for camera in rig.cameras], axis=1)
    seen = _inside_images(rig, pixels)
    cov = np.broadcast_to(rig.noise_px**2 * np.eye(2), (*seen.shape, 2, 2))
    solution = solve_points(rig, np.where(seen[:, :, None], pixels, 0.0), cov, seen)
    calibration = np.einsum("mii->mi", solution.calibration_cov_mm2)
    image = np.einsum("mii->mi", solution.image_cov_mm2)
    return ErrorMap(
        xyz_mm=xyz,
        shape=(nodes, nodes, nodes),
        std_mm=np.sqrt(image + calibration),
        calibration_std_mm=np.sqrt(calibration),
    )


def judged_volume(volume_mm: FloatArray) -> FloatArray:
    """Widen thin sides of a volume, so that a plane of points cannot vouch for itself.

    Parameters
    ----------
    volume_mm : ndarray, shape (2, 3)
        Bounding box of control points.

    Returns
    -------
    ndarray, shape (2, 3)
        The same box, with each side at least a quarter of the longest.
    """
    size = volume_mm[1] - volume_mm[0]
    widened = np.maximum(size, THIN * size.max())
    middle = volume_mm.mean(axis=0)
    return np.stack([middle - widened / 2, middle + widened / 2])


def seen_by(rig: Rig, xyz_mm: FloatArray) -> BoolArray:
    """Tell which points lie inside of which images.

    Parameters
    ----------
    rig : Rig
        C cameras.
    xyz_mm : ndarray, shape (M, 3)
        World points; whether something hides them is not asked.

    Returns
    -------
    ndarray of bool, shape (M, C)
        False behind a camera too.
    """
    pixels = np.stack([camera.project(xyz_mm) for camera in rig.cameras], axis=1)
    return _inside_images(rig, pixels)


def _inside_images(rig: Rig, pixels: FloatArray) -> BoolArray:
    """Return which projections lie inside the images, shape (M, C)."""
    sizes = np.array([camera.size_px for camera in rig.cameras], dtype=np.float64)
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -0.5) & (pixels <= sizes - 0.5)
    return np.asarray(inside.all(axis=2))
