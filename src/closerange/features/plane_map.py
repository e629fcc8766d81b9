"""A flat pattern in the image: its homography and its roll."""

from __future__ import annotations

import numpy as np

from closerange.geometry.arrays import FloatArray

CENTRE_PX = 0.5
"""A centre found in any light is good to that; four points leave no residual that would tell."""

SIGMAS = 3.0
"""Standard deviations by which a roll must keep away from a limit."""


def plane_homography(places: FloatArray, xy_px: FloatArray) -> FloatArray | None:
    """Fit the homography from lattice places to image points by the normalised DLT.

    Parameters
    ----------
    places : ndarray, shape (n, 2)
        Places in the lattice, n >= 4.
    xy_px : ndarray, shape (n, 2)
        Image points, px.

    Returns
    -------
    ndarray, shape (3, 3), or None
        None where the places do not fix it (all but one on a line).

    Notes
    -----
    Hartley & Zisserman, Multiple View Geometry, 2nd ed., algorithm 4.2.
    """
    scaled, t_places = _normalised(places)
    points, t_points = _normalised(xy_px)
    if scaled is None or points is None:
        return None
    x, y = points.T
    ones = np.column_stack([scaled, np.ones(len(scaled))])
    zeros = np.zeros_like(ones)
    design = np.vstack(
        [
            np.hstack([ones, zeros, -x[:, None] * ones]),
            np.hstack([zeros, ones, -y[:, None] * ones]),
        ]
    )
    # of the 9 x 9 normal matrix; a full 2n x 2n basis would be wasted
    values, vectors = np.linalg.eigh(design.T @ design)
    if values[1] < 1e-6 * values[-1]:  # 1e-3 in singular values: two solutions fit alike
        return None
    homography: FloatArray = np.linalg.inv(t_points) @ vectors[:, 0].reshape(3, 3) @ t_places
    return homography


def mapped(homography: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Carry one place into the image.

    Parameters
    ----------
    homography : ndarray, shape (3, 3)
        From lattice to image.
    place : ndarray, shape (2,)
        The place.

    Returns
    -------
    ndarray, shape (2,)
        Image point, px.
    ndarray, shape (2, 2)
        Steps: how it moves, px, for one place along columns (row 0) and along rows (row 1).
    """
    x = homography @ np.array([place[0], place[1], 1.0])
    point = x[:2] / x[2]
    jacobian = (homography[:2, :2] - np.outer(point, homography[2, :2])) / x[2]
    return point, jacobian.T


def roll_rad(px_from_mm: FloatArray) -> float:
    """Return the roll of a plate: the rotation nearest to its affine image.

    Parameters
    ----------
    px_from_mm : ndarray, shape (2, 2)
        Columns: image of one mm along the columns and along the rows (downwards).

    Returns
    -------
    float
        Angle in rad from image x towards image y. Turning the camera about its axis changes
        it by exactly that angle; tilting the plate away about any axis does not change it.
    """
    (a, b), (c, d) = px_from_mm
    return float(np.arctan2(c - b, a + d))


def plane_roll(places: FloatArray, xy_px: FloatArray) -> tuple[float, float]:
    """Return the roll of a pattern at the middle of what is seen of it, and how sure that is.

    Parameters
    ----------
    places : ndarray, shape (n, 2)
        Places on the pattern in equal units, along columns and along rows (downwards), n >= 4.
    xy_px : ndarray, shape (n, 2)
        Image points, px.

    Returns
    -------
    roll_rad : float
        As `roll_rad`. At one place of the pattern even a strong perspective does not change it; a
        map that ignores perspective is off by up to half a degree.
    margin_rad : float
        Three standard deviations.
    """
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    homography = plane_homography(places, xy_px)
    if homography is None:  # nearly a line: the affine map of least change
        flat = np.column_stack([places - middle, np.ones(len(places))])
        steps = np.linalg.lstsq(flat, xy_px, rcond=None)[0][:2]
        left = 0.0
    else:
        steps = mapped(homography, middle)[1]
        seen = np.array([mapped(homography, place)[0] for place in places])
        left = float(np.sum((seen - xy_px) ** 2)) / max(2 * len(places) - 8, 1)
    reach_px = np.sqrt(np.sum((xy_px - xy_px.mean(axis=0)) ** 2))
    return roll_rad(steps.T), SIGMAS * max(float(np.sqrt(left)), CENTRE_PX) / float(reach_px)


def _normalised(points: FloatArray) -> tuple[FloatArray | None, FloatArray]:
    """Move to the centroid and scale to a mean distance of sqrt(2)."""
    centre = points.mean(axis=0)
    spread = float(np.linalg.norm(points - centre, axis=1).mean())
    if not spread > 0:
        return None, np.eye(3)
    scale = np.sqrt(2) / spread
    transform = np.array(
        [[scale, 0, -scale * centre[0]], [0, scale, -scale * centre[1]], [0, 0, 1]]
    )
    return (points - centre) * scale, transform
