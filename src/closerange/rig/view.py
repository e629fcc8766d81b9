"""What one camera has to explain, and how its residuals are weighed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What one camera has to explain; N points.

    Attributes
    ----------
    name : str
        Of the camera.
    size_px : tuple of int
        Image width and height.
    xyz_mm : ndarray, shape (N, 3)
        Known world positions.
    xy_px : ndarray, shape (N, 2)
        Where they are seen.
    whitener : ndarray, shape (N, 3), or None
        Lower triangle (l11, l21, l22) of each point's W with W C W' = I; None for unit weights.
    """

    name: str
    size_px: tuple[int, int]
    xyz_mm: FloatArray
    xy_px: FloatArray
    whitener: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.xy_px)

    def select(self, rows: BoolArray) -> View:
        """Keep some points."""
        whitener = None if self.whitener is None else self.whitener[rows]
        return View(self.name, self.size_px, self.xyz_mm[rows], self.xy_px[rows], whitener)

    def weighted(self, whitener: FloatArray | None) -> View:
        """Return the same points with other weights."""
        return View(self.name, self.size_px, self.xyz_mm, self.xy_px, whitener)


def whiten(
    whitener: FloatArray | None, residual: FloatArray, columns: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Apply each point's W.

    Parameters
    ----------
    whitener : ndarray, shape (N, 3), or None
        As in `View`.
    residual : ndarray, shape (2, N)
        In px.
    columns : ndarray, shape (p, 2, N)
        Columns of the Jacobian.

    Returns
    -------
    residual, columns : ndarrays, shapes (2, N), (p, 2, N)
        In standard deviations.
    """
    if whitener is None:
        return residual, columns
    a, b, c = whitener.T
    white, rows = np.empty_like(residual), np.empty_like(columns)
    white[0], white[1] = a * residual[0], b * residual[0] + c * residual[1]
    first = columns[:, 0]
    np.multiply(a, first, out=rows[:, 0])
    np.multiply(b, first, out=rows[:, 1])
    rows[:, 1] += c * columns[:, 1]
    return white, rows
