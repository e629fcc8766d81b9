"""From a projection matrix to a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal, Distortion

_SINGULAR = 1e-12  # sine between image axes and view; rounding of a regular matrix makes 1e-15


def camera_from_matrix(
    matrix: ArrayLike,
    name: str,
    size_px: tuple[int, int],
    *,
    distortion: Distortion | None = None,
) -> Camera:
    """Split P = K [R | t] into a camera that projects exactly as P does.

    Parameters
    ----------
    matrix : array_like, shape (3, 4)
        P: world (mm) to homogeneous px; any positive scale, w > 0 in front of the camera (as
        `solve_dlt` returns it; a matrix of unknown sign must first be turned so).
    name : str
        Of the camera.
    size_px : tuple of int
        Image width and height.
    distortion : Distortion, optional
        Lens; without one the camera has none.

    Returns
    -------
    Camera
        With fx, fy > 0 and the skew kept in its matrix. A nearly affine view gives a far-off
        principal point: such numbers predict inside the control volume and mean little by
        themselves.

    Raises
    ------
    GeometryError
        If P is not finite, has rank below three, or is that of a mirrored camera.
    """
    p = np.asarray(matrix, np.float64)
    if p.shape != (3, 4) or not np.isfinite(p).all():
        raise GeometryError(
            f"a projection matrix needs 3 x 4 finite numbers, not shape {p.shape}"
            if p.shape != (3, 4)
            else "the projection matrix is not finite",
            remedy="calibrate again",
        )
    rows = np.linalg.norm(p[:, :3], axis=1)
    volume = float(np.linalg.det(p[:, :3] / rows[:, None])) if rows.all() else 0.0
    if abs(volume) < _SINGULAR:
        raise GeometryError(
            "the projection matrix has no centre: it is affine or singular",
            remedy="calibrate with points at different depths, near enough to show perspective",
        )
    if volume < 0:
        raise GeometryError(
            "the projection matrix is that of a mirrored camera (det R = -1)",
            remedy="use right-handed world axes and unmirrored images",
        )
    k, rotation = _rq(p[:, :3] / rows[2])
    translation = np.linalg.solve(k, p[:, 3] / rows[2])
    return Camera(
        name=name,
        size_px=size_px,
        matrix_px=k,
        camera_from_world=RigidTransform(rotation, translation),
        distortion=BrownIdeal() if distortion is None else distortion,
    )


def _rq(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Factor M = K R, K upper triangular with positive diagonal; the last row has unit length."""
    q, upper = np.linalg.qr(matrix[::-1].T)
    k, rotation = upper.T[::-1, ::-1], q.T[::-1]
    signs = np.sign(np.diag(k))
    k, rotation = np.triu(k * signs), rotation * signs[:, None]
    return k / k[2, 2], rotation
