"""Ellipses: axes, signed distance, area moments, fit to an outline.

An ellipse is its centre and a symmetric positive 2x2 shape matrix M: ``p' M p = 1`` on the
outline, p counted from the centre. M has no angle that loses its meaning on a circle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.geometry.least_squares import levenberg_marquardt


@dataclass(frozen=True, slots=True, eq=False)
class Ellipse:
    """An ellipse in a plane; x before y, any unit of length.

    Attributes
    ----------
    centre : ndarray, shape (2,)
        Centre.
    shape : ndarray, shape (2, 2)
        Symmetric positive definite matrix M, in 1 / length^2.

    Raises
    ------
    GeometryError
        If M is not symmetric positive definite: the curve is no ellipse.
    """

    centre: FloatArray
    shape: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", frozen_array(self.centre, (2,), "centre"))
        object.__setattr__(self, "shape", frozen_array(self.shape, (2, 2), "shape"))
        (xx, xy), (yx, yy) = self.shape
        if not (xx > 0 and xx * yy > xy * yx and abs(xy - yx) <= 1e-9 * (xx + yy)):
            raise GeometryError(
                f"the shape matrix ({xx}, {xy}, {yx}, {yy}) is not positive definite",
                remedy="use points of a closed outline",
            )

    @classmethod
    def of(cls, centre: ArrayLike, a: float, b: float, angle_rad: float = 0.0) -> Ellipse:
        """Build from semi-axes.

        Parameters
        ----------
        centre : array_like, shape (2,)
            Centre.
        a, b : float
            Semi-axes, in the unit of the centre.
        angle_rad : float, optional
            Direction of `a` from +x towards +y.

        Returns
        -------
        Ellipse
            The same curve.
        """
        cos, sin = np.cos(angle_rad), np.sin(angle_rad)
        axes = np.array([[cos, -sin], [sin, cos]])
        return cls(np.asarray(centre), axes @ np.diag([a**-2.0, b**-2.0]) @ axes.T)

    @classmethod
    def of_moments(cls, centre: ArrayLike, covariance: ArrayLike) -> Ellipse:
        """Build the ellipse whose area has given second central moments.

        Parameters
        ----------
        centre : array_like, shape (2,)
            Centroid of the area.
        covariance : array_like, shape (2, 2)
            Second central moments divided by the area: a^2/4, b^2/4 along the axes.

        Returns
        -------
        Ellipse
            The ellipse of these moments.

        Raises
        ------
        GeometryError
            If the covariance is singular.
        """
        matrix = np.asarray(covariance, dtype=np.float64)
        (xx, xy), (_, yy) = matrix
        determinant = xx * yy - xy * xy
        if not determinant > 0:
            raise GeometryError(
                f"moments ({xx}, {xy}, {yy}) belong to a line, not to an ellipse",
                remedy="use a region of at least three points that are not on one line",
            )
        inverse = np.array([[yy, -xy], [-xy, xx]]) / determinant
        return cls(np.asarray(centre), inverse / 4)

    @property
    def axes(self) -> tuple[float, float, float]:
        """Semi-axes a >= b and angle of the major axis, from +x towards +y, in (-pi/2, pi/2]."""
        return axes_of_shape(self.shape[0, 0], self.shape[0, 1], self.shape[1, 1])

    @property
    def area(self) -> float:
        """Area, pi a b."""
        return float(np.pi / np.sqrt(np.linalg.det(self.shape)))

    def signed_distance(self, xy: ArrayLike) -> FloatArray:
        """Measure the distance from the outline, negative inside.

        Parameters
        ----------
        xy : array_like, shape (..., 2)
            Points.

        Returns
        -------
        ndarray, shape (...)
            First-order distance (q - 1) / |grad q| with q = sqrt(p' M p): exact for circles
            and near the outline.
        """
        points = np.asarray(xy, dtype=np.float64)
        px, py = points[..., 0] - self.centre[0], points[..., 1] - self.centre[1]
        wx = self.shape[0, 0] * px + self.shape[0, 1] * py
        wy = self.shape[1, 0] * px + self.shape[1, 1] * py
        square = px * wx + py * wy
        slope = np.sqrt(wx * wx + wy * wy)
        # At the very centre the slope vanishes; -b is the limit along the minor axis.
        inside = -self.axes[1]
        return np.where(slope > 0, (square - np.sqrt(square)) / np.maximum(slope, 1e-300), inside)

    def outline(self, count: int = 64) -> FloatArray:
        """Return points on the outline, shape (count, 2), from the major axis towards +y."""
        a, b, angle = self.axes
        t = 2 * np.pi * np.arange(count) / count
        cos, sin = np.cos(angle), np.sin(angle)
        along, across = a * np.cos(t), b * np.sin(t)
        turned = np.column_stack([cos * along - sin * across, sin * along + cos * across])
        return np.asarray(self.centre + turned)


def axes_of_shape(xx: float, xy: float, yy: float) -> tuple[float, float, float]:
    """Return semi-axes a >= b and angle in (-pi/2, pi/2] of a shape matrix.

    Parameters
    ----------
    xx, xy, yy : float
        Terms of M; positive definite.

    Returns
    -------
    tuple of float
        a, b in length, angle of the major axis in rad; angle 0 for a circle.
    """
    mean, half = (xx + yy) / 2, float(np.hypot((xx - yy) / 2, xy))
    # (xx yy - xy^2) / large instead of mean - half: no cancellation for long ellipses.
    large = mean + half
    small = (xx * yy - xy * xy) / large
    # The major axis belongs to the small eigenvalue, hence the signs; adding 0 turns -0 into +0,
    # which keeps the angle of an ellipse along x at 0 and that along y at +pi/2.
    angle = 0.5 * float(np.arctan2(-2 * xy + 0.0, yy - xx + 0.0))
    return 1 / float(np.sqrt(small)), 1 / float(np.sqrt(large)), angle


def fit_ellipse(xy: ArrayLike, *, max_iterations: int = 50) -> Ellipse:
    """Fit an ellipse to points of an outline by least squares of their distances.

    Parameters
    ----------
    xy : array_like, shape (N, 2)
        At least five points; they need not cover the whole outline.
    max_iterations : int, optional
        Largest number of refining steps; 0 leaves the algebraic fit.

    Returns
    -------
    Ellipse
        Minimises the sum of squared `Ellipse.signed_distance`.

    Raises
    ------
    GeometryError
        If the points are fewer than five or lie on no ellipse.

    Notes
    -----
    Starts from the direct algebraic fit of Halir and Flusser (1998), a numerically stable form
    of doi:10.1109/34.765658, whose bias towards small ellipses the distances then remove.
    """
    points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    if len(points) < 5 or not np.isfinite(points).all():
        raise GeometryError(
            f"{len(points)} points; an ellipse needs five finite ones",
            remedy="give more points of the outline",
        )
    middle = points.mean(axis=0)
    size = float(np.sqrt(((points - middle) ** 2).sum(axis=1).mean())) or 1.0
    p = (points - middle) / size
    start = _direct_fit(p)
    fit = levenberg_marquardt(lambda x: _distances(x, p), start, max_iterations=max_iterations)
    cx, cy, xx, xy_term, yy = fit.x
    shape = np.array([[xx, xy_term], [xy_term, yy]]) / size**2
    return Ellipse(middle + size * np.array([cx, cy]), shape)


def _direct_fit(p: FloatArray) -> FloatArray:
    """Return centre and shape terms of the best algebraic ellipse of normalised points."""
    x, y = p.T
    quadratic = np.column_stack([x * x, x * y, y * y])
    linear = np.column_stack([x, y, np.ones_like(x)])
    s2, s3 = quadratic.T @ linear, linear.T @ linear
    try:
        reduce = -np.linalg.solve(s3, s2.T)
        scatter = quadratic.T @ quadratic + s2 @ reduce
        _, vectors = np.linalg.eig(np.linalg.solve(_CONSTRAINT, scatter))
    except np.linalg.LinAlgError:
        raise _no_ellipse() from None
    vectors = np.real(vectors)
    conditions = 4 * vectors[0] * vectors[2] - vectors[1] ** 2
    if not conditions.max() > 0:
        raise _no_ellipse()
    conic = vectors[:, int(np.argmax(conditions))]
    a, b, c = conic
    d, e, f = reduce @ conic
    matrix = np.array([[a, b / 2], [b / 2, c]])
    centre = np.linalg.solve(2 * matrix, -np.array([d, e]))
    scale = centre @ matrix @ centre - f
    if scale == 0:
        raise _no_ellipse()
    shape = matrix / scale
    return np.array([*centre, shape[0, 0], shape[0, 1], shape[1, 1]])


_CONSTRAINT = np.array([[0.0, 0.0, 2.0], [0.0, -1.0, 0.0], [2.0, 0.0, 0.0]])


def _no_ellipse() -> GeometryError:
    return GeometryError(
        "the points lie on no ellipse (on a line, or on an open curve)",
        remedy="give points from at least half of the outline",
    )


def _distances(x: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Signed distances of points and their derivatives by centre and shape."""
    distance, by_centre, by_shape, _ = distance_terms(x[:5], p)
    return distance, np.column_stack([by_centre, by_shape])


def distance_terms(
    x: FloatArray, xy: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return signed distances with their derivatives, for fits.

    Parameters
    ----------
    x : ndarray, shape (5,)
        Centre x, y and the shape terms xx, xy, yy.
    xy : ndarray, shape (N, 2)
        Points.

    Returns
    -------
    distance : ndarray, shape (N,)
        As `Ellipse.signed_distance`; NaN where the shape is not positive there.
    by_centre : ndarray, shape (N, 2)
        Derivatives by the centre.
    by_shape : ndarray, shape (N, 3)
        Derivatives by xx, xy, yy.
    normalised : ndarray, shape (N,)
        q = sqrt(p' M p): 0 at the centre, 1 on the outline.
    """
    xx, xy_term, yy = x[2:5]
    if not (xx > 0 and xx * yy > xy_term * xy_term):
        bad = np.full(len(xy), np.nan)
        return bad, np.full((len(xy), 2), np.nan), np.full((len(xy), 3), np.nan), bad
    # A point on the centre itself has no direction: it is moved by nothing that matters.
    px, py = xy.T[0] - x[0] + 1e-12, xy.T[1] - x[1]
    wx, wy = xx * px + xy_term * py, xy_term * px + yy * py
    square = px * wx + py * wy
    q = np.sqrt(square)
    slope = np.hypot(wx, wy)
    distance = (square - q) / slope
    by_square = (1 - 0.5 / q) / slope
    by_slope = -distance / slope
    # derivatives of square: 2 w by p; of slope: M w / slope by p
    mx, my = (xx * wx + xy_term * wy) / slope, (xy_term * wx + yy * wy) / slope
    ux, uy = wx / slope, wy / slope
    rows = np.empty((5, len(xy)))  # one parameter a row is quicker to fill
    rows[0] = -2 * by_square * wx - by_slope * mx
    rows[1] = -2 * by_square * wy - by_slope * my
    rows[2] = (by_square * px + by_slope * ux) * px
    rows[3] = 2 * by_square * px * py + by_slope * (ux * py + uy * px)
    rows[4] = (by_square * py + by_slope * uy) * py
    return distance, rows[:2].T, rows[2:].T, q
