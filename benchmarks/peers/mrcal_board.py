"""mrcal: its optimiser with a board in unknown poses, as its tool `mrcal-calibrate-cameras` does.

LENSMODEL_OPENCV4, board warp, regularisation and rejection of outlying corners on, as the tool has
them. It starts from OpenCV's calibration. https://mrcal.secretsauce.net/formulation.html
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import mrcal
import numpy as np
from numpy.typing import NDArray

from peers import opencv_stereo
from peers.mrcal_points import LENS, MM, Calibrated

FloatArray = NDArray[np.float64]


def calibrate(
    board_mm: FloatArray, xy_px: Sequence[Sequence[FloatArray]], size_px: tuple[int, int]
) -> Calibrated:
    """Calibrate two cameras; the board's points run along its columns first."""
    rough = opencv_stereo.calibrate(board_mm, xy_px, size_px, joint=True)
    columns = int(np.count_nonzero(board_mm[:, 1] == board_mm[0, 1]))
    rows, count = len(board_mm) // columns, len(xy_px[0])
    spacing = float(np.linalg.norm(board_mm[1] - board_mm[0])) * MM
    intrinsics = np.array(
        [
            [m[0, 0], m[1, 1], m[0, 2], m[1, 2], *np.ravel(lens)[:4]]
            for m, lens in zip(rough.matrices, rough.lenses, strict=True)
        ]
    )
    pose = rough.poses[1]
    second = np.concatenate([cv2.Rodrigues(pose[:, :3])[0].ravel(), pose[:, 3] * MM])[None]
    row, column = np.mgrid[:rows, :columns]
    places = np.stack([column.ravel(), row.ravel(), np.zeros(len(board_mm))], axis=1) * spacing
    frames = np.empty((count, 6))
    for i in range(count):
        _, turn, shift = cv2.solvePnP(places, xy_px[0][i], rough.matrices[0], rough.lenses[0])
        frames[i] = np.concatenate([turn.ravel(), shift.ravel()])
    seen = np.stack([xy_px[c][i] for i in range(count) for c in (0, 1)])
    weights = np.ones((*seen.shape[:2], 1))
    corners = np.concatenate([seen, weights], axis=2).reshape(-1, rows, columns, 3)
    index = [(i, c, c - 1) for i in range(count) for c in (0, 1)]
    mrcal.optimize(
        intrinsics=intrinsics,
        rt_cam_ref=second,
        rt_ref_frame=frames,
        points=None,
        observations_board=np.ascontiguousarray(corners),
        indices_frame_camintrinsics_camextrinsics=np.array(index, np.int32),
        observations_point=None,
        indices_point_camintrinsics_camextrinsics=None,
        lensmodel=LENS,
        imagersizes=np.array([size_px, size_px], np.int32),
        calobject_warp=np.zeros(2),
        calibration_object_spacing=spacing,
    )
    return Calibrated(intrinsics, np.concatenate([np.zeros((1, 6)), second]))
