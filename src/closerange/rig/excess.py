"""What the covariances of image points leave out, as a calibration's residuals show it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from closerange.geometry.arrays import BoolArray, FloatArray, all_finite
from closerange.rig.camera import Camera
from closerange.rig.observations import Observations
from closerange.rig.weights import Stated, common_variance


def unstated_px(
    observations: Observations,
    cameras: Sequence[Camera],
    kept: BoolArray,
    xy_px: FloatArray,
    dof: int,
) -> float:
    """Return tau, the part of the points' standard deviation that they do not state.

    Parameters
    ----------
    observations : Observations
        N joined points, in the world.
    cameras : sequence of Camera
        As fitted, in the order of the observations.
    kept : ndarray of bool, shape (N,)
        Points that were fitted.
    xy_px : ndarray, shape (N, 2)
        Their image positions, bias-corrected for discs.
    dof : int
        Numbers minus parameters.

    Returns
    -------
    float
        px of one coordinate: with tau^2 added to the stated covariances and the control positions'
        own ``std_mm``, chi^2 equals its degrees of freedom. 0 where no point states a covariance:
        all of the residuals would then pass for the part that is not stated.

    Notes
    -----
    Also for the linear methods, which do not weigh their points: it is not how points were weighed
    that matters, but what their covariances left out.
    """
    stated = all_finite(observations.points.cov_px2, (1, 2)) & observations.usable
    if not stated.any():
        return 0.0
    residuals, covariances = [], []
    for index, camera in enumerate(cameras):
        every = observations.rows(index)
        rows = every[kept[every]]
        xyz, std = observations.xyz_mm[rows], observations.std_mm[rows]
        part = Stated(observations.stated_cov(index)[kept[every]], std, rows)
        residuals.append(xy_px[rows] - camera.project(xyz))
        covariances.append(part.in_image(camera, xyz))
    residual, cov = np.concatenate(residuals), np.concatenate(covariances)
    known = all_finite(residual, 1) & all_finite(cov, (1, 2))
    return float(np.sqrt(common_variance(residual[known], cov[known], dof)))
