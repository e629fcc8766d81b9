"""The calibration of the thesis' chapter 2 as it is printed: eleven parameters, a12 = 1.

Kept for comparison and for reading old parameter sets; `dlt.solve_dlt` is the method to use.

Image coordinates are px measured from the image centre ((W - 1)/2, (H - 1)/2), x right and
y UP. The thesis does not say which way y points; its printed parameters (Fig. 2.4) do: with y
down both cameras would be mirrored (det R = -1) for right-handed world axes.
"""

from __future__ import annotations

import warnings
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import CloseRangeWarning, GeometryError, InputError
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import Camera
from closerange.rig.decompose import camera_from_matrix
from closerange.rig.distortion import Distortion
from closerange.rig.dlt import checked_points, in_front, require_spatial

Solver: TypeAlias = Literal["svd", "normal-equations"]

GAUGE_WARNING = 0.01
"""Relative uncertainty of the scale a12 = 1 from which its bias shows beside the image noise."""

GAUGE_LIMIT = 0.2
"""At five standard deviations from nothing the scale is no longer told from noise: with the
origin at the camera itself it is a ratio of two noises, below 0.2 once in a million."""

_Y_DOWN = np.diag([1.0, -1.0, 1.0])


def centred_from_pixels(xy_px: ArrayLike, size_px: tuple[int, int]) -> FloatArray:
    """Turn pixels into the thesis' image coordinates.

    Parameters
    ----------
    xy_px : array_like, shape (N, 2)
        Pixel (0, 0) is the centre of the top-left pixel, y down.
    size_px : tuple of int
        Image width and height.

    Returns
    -------
    ndarray, shape (N, 2)
        px from the image centre, y up.
    """
    centred: FloatArray = (np.asarray(xy_px, np.float64) - centre_of(size_px)) * (1.0, -1.0)
    return centred


def centre_of(size_px: tuple[int, int]) -> FloatArray:
    """Return the image centre ((W - 1)/2, (H - 1)/2) in px, shape (2,)."""
    return (np.array(size_px, np.float64) - 1) / 2


def solve_thesis_dlt(
    xyz_mm: ArrayLike, xy_centred_px: ArrayLike, *, solver: Solver = "svd"
) -> FloatArray:
    """Solve eq. (2.4) or (2.5) for the eleven parameters of one camera.

    Parameters
    ----------
    xyz_mm : array_like, shape (N, 3)
        Known world points, at least six, not in one plane.
    xy_centred_px : array_like, shape (N, 2)
        Their images, px from the image centre, y up.
    solver : {"svd", "normal-equations"}, optional
        The over-determined system (2.4) by singular value decomposition, or the normal
        equations (2.5) by LU factorisation (the thesis: Crout's), which squares the condition
        number.

    Returns
    -------
    ndarray, shape (11,)
        a1 ... a11 of eq. (2.1), with a12 = 1.

    Raises
    ------
    GeometryError
        If the points cannot fix a camera, lie behind it or are given in left-handed axes (also:
        y counted downwards), or the world's origin lies so near to the camera's
        principal plane that a12 is zero within the noise. The thesis says that a12 "can never
        be equal to zero"; there it is.

    Warns
    -----
    CloseRangeWarning
        If the origin is near enough to that plane to bias the solution.
    """
    if solver not in ("svd", "normal-equations"):
        raise InputError(
            f"unknown solver {solver!r}", remedy='use solver="svd" or solver="normal-equations"'
        )
    xyz, xy = checked_points(xyz_mm, xy_centred_px)
    require_spatial(xyz)
    a, b = _system(xyz, xy)
    best, spread = _least_squares(a, b, xyz.mean(axis=0))
    parameters = _normal_equations(a, b) if solver == "normal-equations" else best
    if not spread < GAUGE_LIMIT:  # NaN included
        raise GeometryError(
            "the scale a12 = 1 is lost: the world's origin lies in the camera's principal plane "
            f"(depth of the points relative to it known to {100 * spread:.0f} %, the limit is "
            f"{100 * GAUGE_LIMIT:.0f} %)",
            remedy="move the origin into the control points, or use the default DLT",
        )
    if spread > GAUGE_WARNING:
        warnings.warn(
            "a12 = 1 biases this calibration: the world's origin lies near the camera's principal "
            f"plane (depth of the points relative to it known to {100 * spread:.1f} %, the limit "
            f"is {100 * GAUGE_WARNING:.0f} %); move the origin into the control points, or use "
            "the default DLT",
            CloseRangeWarning,
            stacklevel=2,
        )
    in_front(_Y_DOWN @ _matrix(parameters), xyz, xy)  # refuses mirrored axes
    return parameters


def thesis_matrix(parameters: ArrayLike, size_px: tuple[int, int]) -> FloatArray:
    """Turn eleven parameters into a projection matrix.

    Parameters
    ----------
    parameters : array_like, shape (11,) or more
        a1 ... a11; further ones (lens terms) are not looked at.
    size_px : tuple of int
        Image width and height.

    Returns
    -------
    ndarray, shape (3, 4)
        World (mm) to homogeneous px: (0, 0) is the centre of the top-left pixel, y down. w has
        the sign of a12 = 1: positive at the world's origin.
    """
    to_pixels = _Y_DOWN.copy()
    to_pixels[:2, 2] = centre_of(size_px)
    matrix: FloatArray = to_pixels @ _matrix(parameters)
    return matrix


def camera_from_thesis(
    parameters: ArrayLike,
    name: str,
    size_px: tuple[int, int],
    *,
    distortion: Distortion | None = None,
) -> Camera:
    """Turn eleven parameters into a camera.

    Parameters
    ----------
    parameters : array_like, shape (11,) or more
        a1 ... a11.
    name : str
        Of the camera.
    size_px : tuple of int
        Image width and height.
    distortion : Distortion, optional
        Lens; without one the camera has none.

    Returns
    -------
    Camera
        Which projects as eq. (2.1) does.

    Raises
    ------
    GeometryError
        If the parameters are those of no camera. A world origin behind the camera gives
        a mirrored matrix of opposite sign, which is turned.
    """
    matrix = thesis_matrix(parameters, size_px)
    # a12 = 1 also when the origin lies behind the camera: then w < 0 in front, and det < 0
    if np.isfinite(matrix).all() and np.linalg.det(matrix[:, :3]) < 0:
        matrix = -matrix
    return camera_from_matrix(matrix, name, size_px, distortion=distortion)


def _matrix(parameters: ArrayLike) -> FloatArray:
    return np.append(np.asarray(parameters, np.float64)[:11], 1.0).reshape(3, 4)


def _system(xyz: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Write eq. (2.3) for all points: A (2N, 11) and B (2N)."""
    rows = np.zeros((len(xyz), 2, 11))
    rows[:, 0, 0:4] = rows[:, 1, 4:8] = np.column_stack([xyz, np.ones(len(xyz))])
    rows[:, :, 8:11] = -xy[:, :, None] * xyz[:, None, :]
    return rows.reshape(-1, 11), xy.reshape(-1)


def _least_squares(a: FloatArray, b: FloatArray, mean_mm: FloatArray) -> tuple[FloatArray, float]:
    """Solve by SVD; also return the relative uncertainty of w at the points' mean.

    Columns are brought to one length, which changes no minimum and keeps all digits.
    """
    length = np.linalg.norm(a, axis=0)
    if not length.all():
        raise _undetermined()
    u, singular, vt = np.linalg.svd(a / length, full_matrices=False)
    if singular[-1] < np.finfo(float).eps * len(b) * singular[0]:
        raise _undetermined()
    parameters = vt.T @ ((u.T @ b) / singular) / length
    variance = np.sum((a @ parameters - b) ** 2) / max(len(b) - 11, 1)
    # w at the mean, relative to a12 = 1, is 1 + (a9, a10, a11) . mean
    weights = (vt[:, 8:11] / length[8:11]) @ mean_mm / singular
    spread = np.sqrt(variance) * np.linalg.norm(weights)
    return parameters, float(spread / abs(1 + parameters[8:11] @ mean_mm))


def _normal_equations(a: FloatArray, b: FloatArray) -> FloatArray:
    try:
        solution: FloatArray = np.linalg.solve(a.T @ a, a.T @ b)
    except np.linalg.LinAlgError as error:
        raise _undetermined() from error
    return solution


def _undetermined() -> GeometryError:
    return GeometryError(
        "the eleven parameters are not determined: the equations (2.4) are singular",
        remedy="spread the points in depth and, if the world's origin is at the camera, move it",
    )
