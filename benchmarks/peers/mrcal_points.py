"""mrcal: its optimiser with fixed points, its unprojection and its triangulation.

`mrcal.optimize` with all points fixed and both cameras free; lens model LENSMODEL_OPENCV4, which
has exactly fx fy cx cy k1 k2 p1 p2. mrcal's regularisation is on unless told otherwise.
https://mrcal.secretsauce.net/formulation.html. Lengths are metres inside, as its ranges assume.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import mrcal
import numpy as np
from numpy.typing import NDArray

from peers.linear_start import start

FloatArray = NDArray[np.float64]

LENS = "LENSMODEL_OPENCV4"
MM = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """Parameters of each of two cameras and their poses from the world."""

    intrinsics: FloatArray
    poses: FloatArray

    def positions(self, xy_px: Sequence[FloatArray]) -> FloatArray:
        """Triangulate with `mrcal.triangulate_lindstrom`, shape (M, 3) in mm."""
        first_from_second = mrcal.compose_Rt(
            mrcal.Rt_from_rt(self.poses[0]), mrcal.invert_Rt(mrcal.Rt_from_rt(self.poses[1]))
        )
        rays = [
            mrcal.unproject(np.ascontiguousarray(seen), LENS, lens)
            for seen, lens in zip(xy_px, self.intrinsics, strict=True)
        ]
        in_first = mrcal.triangulate_lindstrom(
            rays[0], rays[1], v_are_local=True, Rt01=first_from_second
        )
        world = mrcal.transform_point_Rt(mrcal.invert_Rt(mrcal.Rt_from_rt(self.poses[0])), in_first)
        return world / MM


def calibrate(
    xyz_mm: FloatArray,
    xy_px: Sequence[FloatArray],
    sizes_px: Sequence[tuple[int, int]],
    *,
    regularised: bool = True,
) -> Calibrated:
    """Optimise both cameras in one problem."""
    cameras, count = len(xy_px), len(xyz_mm)
    intrinsics, poses = np.zeros((cameras, 8)), np.zeros((cameras, 6))
    for i, (seen, size) in enumerate(zip(xy_px, sizes_px, strict=True)):
        matrix, rotation, shift = start(xyz_mm, seen, size)
        intrinsics[i, :4] = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
        poses[i, :3], poses[i, 3:] = cv2.Rodrigues(rotation)[0].ravel(), shift * MM
    camera, point = np.repeat(np.arange(cameras), count), np.tile(np.arange(count), cameras)
    mrcal.optimize(
        intrinsics=intrinsics,
        rt_cam_ref=poses,
        rt_ref_frame=None,
        points=xyz_mm * MM,
        observations_board=None,
        indices_frame_camintrinsics_camextrinsics=None,
        observations_point=np.column_stack([np.concatenate(xy_px), np.ones(cameras * count)]),
        indices_point_camintrinsics_camextrinsics=np.column_stack([point, camera, camera]).astype(
            np.int32
        ),
        lensmodel=LENS,
        imagersizes=np.array(sizes_px, np.int32),
        Npoints_fixed=count,
        do_optimize_frames=False,
        do_optimize_calobject_warp=False,
        do_apply_outlier_rejection=False,
        do_apply_regularization=regularised,
        point_min_range=0.01,
        point_max_range=100.0,
    )
    return Calibrated(intrinsics, poses)
