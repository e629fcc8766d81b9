"""OpenCV: `calibrateCamera` for each camera, then `stereoCalibrate`, from a flat board.

By default `stereoCalibrate` holds lenses and matrices fixed (``CALIB_FIX_INTRINSIC``); `joint`
frees them from there. Z. Zhang, 2000, doi:10.1109/34.888718;
https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from peers.opencv_points import Calibrated

FloatArray = NDArray[np.float64]


def calibrate(
    board_mm: FloatArray,
    xy_px: Sequence[Sequence[FloatArray]],
    size_px: tuple[int, int],
    *,
    joint: bool,
) -> Calibrated:
    """Calibrate two cameras; `xy_px` has one list of placements a camera.

    `joint` frees fx fy cx cy k1 k2 p1 p2 of both cameras together with all poses; otherwise
    OpenCV's defaults are taken, k3 free and the lenses fixed in the second step.
    """
    flags = cv2.CALIB_FIX_K3 if joint else 0
    seen = [[xy.astype(np.float32) for xy in placements] for placements in xy_px]
    board = [board_mm.astype(np.float32)] * len(seen[0])
    single = [cv2.calibrateCamera(board, own, size_px, None, None, flags=flags) for own in seen]
    flags |= cv2.CALIB_USE_INTRINSIC_GUESS if joint else cv2.CALIB_FIX_INTRINSIC
    found = cv2.stereoCalibrate(
        board, *seen, *single[0][1:3], *single[1][1:3], size_px, flags=flags
    )
    first, first_lens, second, second_lens, rotation, shift = found[1:7]
    poses = [np.eye(3, 4), np.column_stack([rotation, np.ravel(shift)])]
    return Calibrated([first, second], [first_lens, second_lens], poses)
