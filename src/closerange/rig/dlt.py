"""The direct linear transformation, solved without a gauge that can fail."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError, InputError
from closerange.geometry.arrays import FloatArray, frozen_array

MIN_POINTS = 6
"""Eleven unknowns, two equations a point."""

MIN_THICKNESS = 1e-3
"""Least thickness over extent of control points. Below it (0.1 mm over 100 mm) depth is of the
size of a plate's own flatness and of hand-measured coordinates: the points are a plane."""

USEFUL_THICKNESS = 1 / 6
"""Thickness over extent to ask for: there depth is about three times worse than with a cube,
against a hundred times for a plane."""

MAX_CONDITION = 1e8
"""Largest condition number of the normalised equations. Image noise is 1e-4 of the picture at
best; a direction fixed ten thousand times more weakly than that is not fixed at all."""

MIN_RELIEF = 1e-10
"""Least relative change of depth over the points; rounding alone makes 1e-13."""


@dataclass(frozen=True, slots=True, eq=False)
class DltSolution:
    """A projection matrix from known points, without lens distortion.

    Attributes
    ----------
    matrix : ndarray, shape (3, 4)
        P: world (mm) to homogeneous px. Scaled so that w is the depth in mm, positive in front.
    condition : float
        Largest over smallest non-zero singular value of the normalised equations.
    residual_px : ndarray, shape (N, 2)
        Observed minus calculated.
    """

    matrix: FloatArray
    condition: float
    residual_px: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", frozen_array(self.matrix, (3, 4), "matrix"))
        object.__setattr__(
            self, "residual_px", frozen_array(self.residual_px, (None, 2), "residual_px")
        )

    @property
    def rms_px(self) -> float:
        """Root mean square of one residual coordinate."""
        return float(np.sqrt(np.mean(self.residual_px**2)))


def solve_dlt(xyz_mm: ArrayLike, xy_px: ArrayLike) -> DltSolution:
    """Find the projection matrix of one camera from known points.

    Minimises the algebraic error under a unit norm by singular value decomposition, in
    coordinates moved and scaled to unit size on both sides. Unlike the thesis' a12 = 1
    (`thesis_dlt`) this holds wherever the world's origin lies. Lens distortion is not modelled:
    points should be undistorted, or the result taken as a start.

    Parameters
    ----------
    xyz_mm : array_like, shape (N, 3)
        Known world points, at least six, not in one plane; right-handed axes.
    xy_px : array_like, shape (N, 2)
        Their images; pixel (0, 0) is the centre of the top-left pixel, y down.

    Returns
    -------
    DltSolution
        Matrix, condition number and residuals.

    Raises
    ------
    InputError
        If the shapes do not fit each other.
    GeometryError
        If points are too few, not finite, collinear, coplanar or otherwise unable to fix the
        matrix, behind the camera, or given in left-handed axes.

    References
    ----------
    Y. I. Abdel-Aziz, H. M. Karara, 1971, doi:10.14358/PERS.81.2.103 (reprint);
    R. I. Hartley, "In defense of the eight-point algorithm", doi:10.1109/34.601246.
    """
    xyz, xy = checked_points(xyz_mm, xy_px)
    require_spatial(xyz)
    to_unit_world, to_unit_image = _normalisation(xyz), _normalisation(xy)
    world, image = _apply(to_unit_world, xyz), _apply(to_unit_image, xy)
    singular, vt = np.linalg.svd(_equations(world, image), full_matrices=False)[1:]
    if singular[10] * MAX_CONDITION < singular[0]:
        raise GeometryError(
            f"the {len(xyz)} points do not fix a camera: condition number "
            f"{singular[0] / max(singular[10], np.finfo(float).tiny):.1e}, "
            f"the limit is {MAX_CONDITION:.0e}",
            remedy="at least two points must lie off every plane through the others, none on the "
            "spot of another: add points at other depths",
        )
    matrix = np.linalg.solve(to_unit_image, vt[11].reshape(3, 4)) @ to_unit_world
    matrix = in_front(matrix, xyz, xy)
    homogeneous = xyz @ matrix[:, :3].T + matrix[:, 3]
    residual = xy - homogeneous[:, :2] / homogeneous[:, 2:]
    return DltSolution(matrix, float(singular[0] / singular[10]), residual)


def checked_points(xyz_mm: ArrayLike, xy_px: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return both sides as float64 arrays.

    Parameters
    ----------
    xyz_mm : array_like, shape (N, 3)
        World points.
    xy_px : array_like, shape (N, 2)
        Their images.

    Returns
    -------
    xyz_mm, xy_px : ndarrays, shapes (N, 3), (N, 2)
        The same numbers.

    Raises
    ------
    InputError
        If the shapes do not fit each other.
    GeometryError
        If a number is not finite, or there are fewer than six points.
    """
    xyz, xy = np.asarray(xyz_mm, np.float64), np.asarray(xy_px, np.float64)
    if xyz.ndim != 2 or xy.ndim != 2 or xyz.shape != (len(xy), 3) or xy.shape != (len(xyz), 2):
        raise InputError(
            f"world points have shape {xyz.shape}, image points {xy.shape}; "
            "expected (N, 3) and (N, 2)",
            remedy="give one image point for each world point",
        )
    bad = ~(np.isfinite(xyz).all(axis=1) & np.isfinite(xy).all(axis=1))
    if bad.any():
        raise GeometryError(
            f"{np.count_nonzero(bad)} of {len(xyz)} points are not finite, "
            f"the first is number {np.flatnonzero(bad)[0]} (from 0)",
            remedy="leave out points that were not measured",
        )
    if len(xyz) < MIN_POINTS:
        raise GeometryError(
            f"{len(xyz)} points, a camera needs at least {MIN_POINTS}",
            remedy="add control points at different depths",
        )
    return xyz, xy


def require_spatial(xyz_mm: FloatArray) -> None:
    """Refuse points on one spot, one line or one plane.

    Parameters
    ----------
    xyz_mm : ndarray, shape (N, 3)
        World points, finite.

    Raises
    ------
    GeometryError
        With thickness and extent in mm.
    """
    centred = xyz_mm - xyz_mm.mean(axis=0)
    axes = np.linalg.svd(centred, full_matrices=False)[2]
    _, width, thickness = np.ptp(centred @ axes.T, axis=0)
    # not the range along the first axis: that axis is arbitrary for square and round sets
    extent = 2 * float(np.linalg.norm(centred, axis=1).max())
    depth = USEFUL_THICKNESS * extent
    if extent <= 0:
        raise GeometryError(
            f"all {len(xyz_mm)} control points lie on one spot", remedy="give their positions in mm"
        )
    if width < MIN_THICKNESS * extent:
        raise GeometryError(
            f"the control points lie on one line ({width:.2g} mm wide over {extent:.4g} mm; "
            f"the limit is {MIN_THICKNESS * extent:.2g} mm)",
            remedy=f"add points at least {depth:.2g} mm to the side, and as far in front or behind",
        )
    if thickness < MIN_THICKNESS * extent:
        raise GeometryError(
            f"the control points lie in one plane ({thickness:.2g} mm thick over {extent:.4g} mm; "
            f"the limit is {MIN_THICKNESS * extent:.2g} mm). A plane cannot fix depth",
            remedy=f"add a placement at least {depth:.2g} mm in front or behind",
        )


def in_front(matrix: FloatArray, xyz: FloatArray, xy: FloatArray) -> FloatArray:
    """Scale P so that w is the depth in mm, positive for all points.

    Parameters
    ----------
    matrix : ndarray, shape (3, 4)
        P of any scale and sign, for image coordinates with y down.
    xyz : ndarray, shape (N, 3)
        World points, mm.
    xy : ndarray, shape (N, 2)
        Their images, px.

    Returns
    -------
    ndarray, shape (3, 4)
        The scaled matrix.

    Raises
    ------
    GeometryError
        If points lie behind the camera, there is no perspective, or axes are left-handed.
    """
    depth = xyz @ matrix[2, :3] + matrix[2, 3]
    sign = 1.0 if np.count_nonzero(depth > 0) * 2 >= len(depth) else -1.0
    depth, matrix = depth * sign, matrix * sign
    behind = np.count_nonzero(depth <= 0)
    if behind:
        raise GeometryError(
            f"{behind} of {len(depth)} points would lie behind the camera",
            remedy="check that image and world points are paired rightly, that x and y are not "
            "exchanged and that no axis is mirrored",
        )
    relief = float(np.ptp(depth) / depth.mean())
    if relief < MIN_RELIEF:
        raise GeometryError(
            f"the view has no perspective: depth changes by {relief:.1e} over the points, "
            f"the limit is {MIN_RELIEF:.0e}",
            remedy="come nearer; a telecentric lens cannot be modelled as a pinhole",
        )
    if np.linalg.det(matrix[:, :3]) < 0:
        weak = relief * float(np.ptp(xy, axis=0).max()) / 2
        raise GeometryError(
            "the points fit only a mirrored camera (det R = -1): the control axes are "
            "left-handed, or the image is mirrored or its y counted upwards",
            remedy="turn the sign of one axis, or exchange two columns, so that x, y, z are "
            f"right-handed; if they are, perspective ({weak:.2g} px) drowns in the errors of the "
            "points: add depth or come nearer",
        )
    scaled: FloatArray = matrix / np.linalg.norm(matrix[2, :3])
    return scaled


def _normalisation(points: FloatArray) -> FloatArray:
    """Return the similarity that moves points to the origin with unit RMS on each axis."""
    width = points.shape[1]
    mean = points.mean(axis=0)
    scale = 1 / max(np.sqrt(np.mean((points - mean) ** 2)), np.finfo(float).tiny)
    transform = np.eye(width + 1)
    transform[:width, :width] *= scale
    transform[:width, width] = -scale * mean
    return transform


def _apply(transform: FloatArray, points: FloatArray) -> FloatArray:
    moved: FloatArray = points @ transform[:-1, :-1].T + transform[:-1, -1]
    return moved


def _equations(world: FloatArray, image: FloatArray) -> FloatArray:
    """Write p . rows = 0: (p1 - x p3) X = 0 and (p2 - y p3) X = 0, shape (2N, 12)."""
    homogeneous = np.column_stack([world, np.ones(len(world))])
    rows = np.zeros((len(world), 2, 12))
    rows[:, 0, 0:4] = rows[:, 1, 4:8] = homogeneous
    rows[:, :, 8:12] = -image[:, :, None] * homogeneous[:, None, :]
    return rows.reshape(-1, 12)
