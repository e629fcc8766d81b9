"""Starting values for the peers that need some: a camera from the thesis' plain DLT.

`cv2.decomposeProjectionMatrix` splits the matrix into K, R and centre (R. Hartley, A. Zisserman,
Multiple View Geometry, 2003, section 6.2.4). Every peer that iterates starts from the same camera.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from peers import thesis_dlt

FloatArray = NDArray[np.float64]


def start(
    xyz_mm: FloatArray, xy_px: FloatArray, size_px: tuple[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return K (3, 3), R (3, 3) and t (3) in mm of a camera without a lens."""
    found = thesis_dlt.calibrate(xyz_mm, [xy_px], [size_px])
    shift = np.eye(3)
    shift[:2, 2] = found.middles_px[0]
    matrix = shift @ found.matrices[0]
    matrix *= np.sign(np.linalg.det(matrix[:, :3]))
    k, rotation, centre = cv2.decomposeProjectionMatrix(matrix)[:3]
    signs = np.diag(np.sign(np.diag(k)))
    k, rotation = k @ signs, signs @ rotation
    position = (centre[:3] / centre[3]).ravel()
    k = k / k[2, 2]
    k[0, 1] = 0.0
    return k, rotation, -rotation @ position
