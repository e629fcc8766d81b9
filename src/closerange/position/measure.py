"""Measuring: image points and a rig become positions."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from closerange.errors import CloseRangeWarning
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.geometry.covariance import propagate
from closerange.geometry.intersection import widest_angle
from closerange.position.observed import Observed, arrange
from closerange.position.positions import Positions
from closerange.position.triangulate import Solution, solve_points, triangulate_linear
from closerange.rig.disc_bias import DiscViews, disc_centre_bias
from closerange.rig.rig import Rig

MIN_ANGLE_RAD = np.deg2rad(1.0)
"""Rays closer than this are called nearly parallel: depth is a hundred times worse than breadth."""

RESIDUAL_FALSE_ALARM = 1e-4
"""Chance that a good point is flagged for its residual."""

MISSING_SHARE = 0.2
"""Share of points with a large residual above which the rig is suspected, not the points: wrong
pairs are rarer. Exchanged cameras of a symmetric pair give less than half."""

MISSING_POINTS = 3
"""Fewer points with a large residual may be chance blunders."""

OUTSIDE_SIGMA = 3.0
"""A point counts as outside the volume when it is so by more than its own uncertainty."""


def measure_points(rig: Rig, points: ImagePoints) -> Positions:
    """Turn image points of two or more cameras into world positions.

    Parameters
    ----------
    rig : Rig
        Calibrated cameras.
    points : ImagePoints
        Rows of one (placement, reading, point) in several cameras belong together. Rows without
        a covariance get that of the calibration, s^2 I.

    Returns
    -------
    Positions
        One row for each (placement, reading, point), in order of appearance. Points that two
        rays do not define are NaN and flagged.

    Raises
    ------
    InputError
        If a camera is not in the rig, or a point lies outside of its image.

    Notes
    -----
    Equations (2.9) to (2.11) and (5.6), then weighted reprojection error minimised by
    Gauss-Newton. Disc centres are corrected for perspective and lens (see
    `closerange.rig.disc_bias`). The covariance adds the image points' part and the calibration's;
    what differs between readings is propagated from the image points' noise alone.
    """
    observed = arrange(rig, points)
    observed = _without_disc_bias(rig, observed)
    solution = solve_points(rig, observed.xy_px, observed.cov_px2, observed.used)
    flags = observed.flags | _geometry_flags(rig, observed, solution)
    if not rig.trusted:
        flags = flags | Flag.untrusted
    squares = np.where(observed.used[:, :, None], solution.residual_px, 0.0) ** 2
    used = observed.used.sum(axis=1)
    rms = np.sqrt(squares.sum(axis=(1, 2)) / np.maximum(2 * used, 1))
    _warn_if_rays_miss(rig, flags, rms)
    defined = all_finite(solution.xyz_mm, 1)
    return Positions(
        placement=observed.placement,
        reading=observed.reading,
        point=observed.point,
        xyz_mm=solution.xyz_mm,
        cov_mm2=solution.image_cov_mm2 + solution.calibration_cov_mm2,
        residual_px=np.where(defined, rms, np.nan),
        cameras=used,
        flags=flags,
        dof=None if observed.own_cov else rig.dof,
        noise_cov_mm2=_noise(observed, solution),
    )


def _noise(observed: Observed, solution: Solution) -> FloatArray:
    """Propagate the noise of the views that take part; NaN where one of them has none stated."""
    noise = np.where(observed.used[..., None, None], observed.noise_cov_px2, 0.0)
    cov: FloatArray = propagate(solution.by_image, noise).sum(axis=1)
    return cov


def _without_disc_bias(rig: Rig, observed: Observed) -> Observed:
    """Subtract the bias of disc centres, at the position that they have without it."""
    if not np.isfinite(observed.diameter_mm).any():
        return observed
    xyz = triangulate_linear(rig, observed.xy_px, observed.used)
    views = DiscViews(xyz, observed.ellipse, observed.diameter_mm)
    # 0.1 px of bias moves the position by 0.1 mm or less, which changes the bias by 1e-5 px
    return replace(observed, xy_px=observed.xy_px - disc_centre_bias(rig.cameras, views))


def _geometry_flags(rig: Rig, observed: Observed, solution: Solution) -> IntArray:
    used, xyz = observed.used, solution.xyz_mm
    too_few = used.sum(axis=1) < 2
    directions = np.stack(
        [camera.directions(observed.xy_px[:, i]) for i, camera in enumerate(rig.cameras)], axis=1
    )
    parallel = ~too_few & (widest_angle(directions, used) < MIN_ANGLE_RAD)
    depths = np.stack([camera.depth_mm(xyz) for camera in rig.cameras], axis=1)
    behind = (used & (depths <= 0)).any(axis=1)
    undefined = ~too_few & ~parallel & ~behind & ~all_finite(xyz, 1)
    flags = np.zeros(len(xyz), dtype=np.int64)
    for rows, flag in (
        (too_few, Flag.single_view),
        (parallel, Flag.near_parallel),
        (behind, Flag.behind_camera),
        (undefined, Flag.not_converged),
        (_outside(rig, solution), Flag.outside_volume),
        (_rays_miss(rig, observed, solution), Flag.residual),
    ):
        flags[rows] |= int(flag)
    return flags


def _outside(rig: Rig, solution: Solution) -> BoolArray:
    cov = solution.image_cov_mm2 + solution.calibration_cov_mm2
    margin = OUTSIDE_SIGMA * np.sqrt(np.einsum("mii->mi", np.nan_to_num(cov)))
    below = solution.xyz_mm < rig.volume_mm[0] - margin
    above = solution.xyz_mm > rig.volume_mm[1] + margin
    return np.asarray((below | above).any(axis=1))


def _rays_miss(rig: Rig, observed: Observed, solution: Solution) -> BoolArray:
    """Test residuals against image noise, calibration uncertainty and the rig's own misfit.

    The rig's noise holds what the calibration could not model (target errors, lens): rays miss
    each other by that much in good measurements too, however small a covariance is stated.
    """
    from scipy.stats import chi2  # noqa: PLC0415  # takes half a second: only when measuring

    cov = observed.cov_px2 + solution.predicted_px2 + rig.noise_px**2 * np.eye(2)
    used = observed.used & all_finite(solution.residual_px, 2)
    cov = np.where(used[..., None, None], cov, np.eye(2))
    residual = np.where(used[..., None], solution.residual_px, 0.0)
    squared = np.einsum("mci,mci->m", residual, np.linalg.solve(cov, residual[..., None])[..., 0])
    dof = 2 * used.sum(axis=1) - 3
    limit = chi2.isf(RESIDUAL_FALSE_ALARM, np.maximum(dof, 1))
    return np.asarray((dof > 0) & (squared > limit))


def _warn_if_rays_miss(rig: Rig, flags: IntArray, rms: FloatArray) -> None:
    missing = (flags & int(Flag.residual)) != 0
    if missing.sum() >= MISSING_POINTS and missing.mean() > MISSING_SHARE:
        warnings.warn(
            f"the rays of {int(missing.sum())} of {len(flags)} points miss each other by "
            f"{np.median(rms[missing]):.2f} px rms, the calibration left {rig.noise_px:.3f} px: a "
            "camera was moved, the cameras are exchanged or this is another rig's file",
            CloseRangeWarning,
            stacklevel=3,
        )
