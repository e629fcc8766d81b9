"""OpenCV: `calibrateCamera` from known points, then `triangulatePoints`.

Each camera is calibrated by itself from one view of spatial points, which needs a start
(``CALIB_USE_INTRINSIC_GUESS``); its pose comes with it. Positions are the linear intersection of
undistorted points. https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from peers.linear_start import start

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """K, lens and [R | t] of each of two cameras."""

    matrices: list[FloatArray]
    lenses: list[FloatArray]
    poses: list[FloatArray]

    def positions(self, xy_px: Sequence[FloatArray]) -> FloatArray:
        """Intersect the rays of two cameras, shape (M, 3) in mm."""
        rays = [
            cv2.undistortPoints(seen.reshape(-1, 1, 2), matrix, lens).reshape(-1, 2).T
            for seen, matrix, lens in zip(xy_px, self.matrices, self.lenses, strict=True)
        ]
        found = cv2.triangulatePoints(self.poses[0], self.poses[1], rays[0], rays[1])
        return (found[:3] / found[3]).T


def calibrate(
    xyz_mm: FloatArray,
    xy_px: Sequence[FloatArray],
    sizes_px: Sequence[tuple[int, int]],
    *,
    free_k3: bool = False,
) -> Calibrated:
    """Calibrate each camera; ``free_k3`` is OpenCV's own default model."""
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | (0 if free_k3 else cv2.CALIB_FIX_K3)
    world = xyz_mm.astype(np.float32)
    matrices, lenses, poses = [], [], []
    for seen, size in zip(xy_px, sizes_px, strict=True):
        guess = start(xyz_mm, seen, size)[0]
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            [world], [seen.astype(np.float32)], size, guess, np.zeros(5), flags=flags
        )
        matrices.append(matrix)
        lenses.append(lens)
        poses.append(np.column_stack([cv2.Rodrigues(turns[0])[0], np.ravel(shifts[0])]))
    return Calibrated(matrices, lenses, poses)
