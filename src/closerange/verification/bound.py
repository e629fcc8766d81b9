"""The Cramer-Rao bound: the least covariance any unbiased calibration can reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import Camera

BROWN = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "rx", "ry", "rz", "tx", "ty", "tz")
"""Free parameters of the model ``brown``."""

# Columns are scaled to unit length first; below this ratio of singular values float64 leaves
# fewer than four digits in the inverse of J'J, whose condition is the square.
_SINGULAR = 1e-6


def position_bound(
    cameras: Sequence[Camera],
    names: Sequence[str],
    control_mm: ArrayLike,
    held_out_mm: ArrayLike,
    noise_px: float,
) -> tuple[FloatArray, FloatArray]:
    """Bound the covariance of positions measured with a rig calibrated from exact points.

    The calibration's part is what noise-free pixels would leave and what averaging cannot
    remove. Cameras are calibrated independently of each other, since the control is exact;
    what held-out pixels themselves could add to the calibration is not used.

    Parameters
    ----------
    cameras : sequence of Camera
        The truth; at least two.
    names : sequence of str
        Free parameters of each camera, for instance `BROWN`.
    control_mm : array_like, shape (N, 3)
        Control points of the calibration.
    held_out_mm : array_like, shape (M, 3)
        Positions to be measured afterwards.
    noise_px : float
        Standard deviation of one image coordinate, in calibration and measurement.

    Returns
    -------
    total_mm2, calibration_mm2 : ndarray, shape (M, 3, 3)
        Bounds of the covariance; NaN where a camera cannot see the position.

    Raises
    ------
    GeometryError
        If the points do not fix the parameters.
    """
    held_out = np.reshape(np.asarray(held_out_mm, np.float64), (-1, 3))
    by_position = np.concatenate([camera.project_jacobian(held_out) for camera in cameras], axis=1)
    pixel = np.linalg.pinv(by_position.swapaxes(1, 2) @ by_position, hermitian=True)
    solve = pixel @ by_position.swapaxes(1, 2)  # d position / d pixels, (M, 3, 2C)
    calibration = np.zeros_like(pixel)
    for i, camera in enumerate(cameras):
        root = _parameter_root(camera, names, control_mm)
        moved = solve[:, :, 2 * i : 2 * i + 2] @ camera.parameter_jacobian(held_out, names) @ root
        calibration += moved @ moved.swapaxes(1, 2)
    return noise_px**2 * (pixel + calibration), noise_px**2 * calibration


def rms_3d_mm(cov_mm2: ArrayLike) -> float:
    """Return the expected 3-D RMS error, sqrt of the mean trace, of covariances (M, 3, 3)."""
    return float(np.sqrt(np.trace(np.asarray(cov_mm2), axis1=1, axis2=2).mean()))


def _parameter_root(camera: Camera, names: Sequence[str], control_mm: ArrayLike) -> FloatArray:
    """Return F with ``F F' = (J'J)^-1``, from the singular values of the scaled J."""
    jacobian = camera.parameter_jacobian(control_mm, names)
    seen = np.isfinite(jacobian).all(axis=(1, 2))
    rows = jacobian[seen].reshape(-1, len(names))
    if len(rows) < len(names):
        raise GeometryError(
            f"camera {camera.name!r}: {len(rows)} image coordinates cannot fix "
            f"{len(names)} parameters",
            remedy="use more control points or free fewer parameters",
        )
    length = np.linalg.norm(rows, axis=0)
    scale = np.where(length > 0, length, 1.0)
    _, singular, vt = np.linalg.svd(rows / scale, full_matrices=False)
    ratio = float(singular[-1] / singular[0]) if singular.size else 1.0
    if ratio < _SINGULAR:
        raise GeometryError(
            f"camera {camera.name!r}: the control points do not fix {', '.join(names)} "
            f"(ratio of singular values {ratio:.1e}, limit {_SINGULAR:.0e})",
            remedy="spread the points in depth or free fewer parameters",
        )
    root: FloatArray = vt.T / singular / scale[:, None]
    return root
