"""The plain direct linear transformation of the thesis' chapter 2: no lens, a12 = 1.

M. T. Boraie, PhD thesis, University of Windsor, 1989: equations (2.3) and (2.4) give eleven
parameters a camera, (2.9) to (2.11) the position as the least-squares solution of two equations
a view. The same as Y. I. Abdel-Aziz, H. M. Karara, 1971, doi:10.14358/PERS.81.2.103 (reprint).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """One 3x4 matrix a camera, for px from the image centre."""

    matrices: list[FloatArray]
    middles_px: list[FloatArray]

    def positions(self, xy_px: Sequence[FloatArray]) -> FloatArray:
        """Solve (2.9) to (2.11) for each point: (a1 - x a9) X + ... = x - a4, shape (M, 3)."""
        rows = []
        for matrix, middle, seen in zip(self.matrices, self.middles_px, xy_px, strict=True):
            for axis in (0, 1):
                image = (seen - middle)[:, axis, None]
                rows.append(matrix[axis] - image * matrix[2])
        system = np.stack(rows, axis=1)
        a, b = system[:, :, :3], -system[:, :, 3:]
        at = np.swapaxes(a, 1, 2)
        return np.linalg.solve(at @ a, at @ b)[..., 0]


def calibrate(
    xyz_mm: FloatArray, xy_px: Sequence[FloatArray], sizes_px: Sequence[tuple[int, int]]
) -> Calibrated:
    """Solve (2.4) for each camera by singular value decomposition."""
    matrices, middles = [], []
    for seen, size in zip(xy_px, sizes_px, strict=True):
        middle = (np.array(size, np.float64) - 1) / 2
        xy = seen - middle
        rows = np.zeros((len(xyz_mm), 2, 11))
        rows[:, 0, 0:4] = rows[:, 1, 4:8] = np.column_stack([xyz_mm, np.ones(len(xyz_mm))])
        rows[:, :, 8:11] = -xy[:, :, None] * xyz_mm[:, None, :]
        parameters = np.linalg.lstsq(rows.reshape(-1, 11), xy.reshape(-1), rcond=None)[0]
        matrices.append(np.append(parameters, 1.0).reshape(3, 4))
        middles.append(middle)
    return Calibrated(matrices, middles)
