"""Measuring: image points and a rig become positions."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np

from closerange.errors import CloseRangeWarning
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.geometry.covariance import positive_definite, propagate
from closerange.geometry.intersection import widest_angle
from closerange.position.observed import Observed, arrange
from closerange.position.positions import Positions
from closerange.position.suspicion import Doubt, DoubtWarning, find_doubt
from closerange.position.triangulate import Solution, solve_points, triangulate_linear
from closerange.rig.disc_bias import DiscViews, disc_centre_bias
from closerange.rig.observations import EXCLUDING
from closerange.rig.rig import Rig

MIN_ANGLE_RAD = np.deg2rad(1.0)
"""Rays closer than this are called nearly parallel: depth is a hundred times worse than breadth."""

RESIDUAL_FALSE_ALARM = 1e-4
"""Chance that a good point is flagged for its residual."""

CONTRADICTING = Flag.residual | Flag.behind_camera | Flag.not_converged
"""What true points in a true rig never show: the rays miss, or meet where no camera looks."""

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
        a covariance get that of the calibration, s^2 I; others are believed but for tau^2 I, what
        such covariances left out in the calibration.

    Returns
    -------
    Positions
        One row for each (placement, reading, point), in order of appearance. Points that two
        rays do not define are NaN and flagged.

    Raises
    ------
    InputError
        If a camera is not in the rig, or a point lies outside of its image.

    Warns
    -----
    DoubtWarning
        If most points contradict the rig, or exchanged cameras or another image size explain why
        many do: `Positions.doubt` then says the same.
    CloseRangeWarning
        If many points contradict it.

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
    found = _geometry_flags(rig, observed, solution)
    rms = _rms(observed, solution)
    doubt = _doubt(rig, points, observed, found, rms)
    if doubt is not None:
        warnings.warn(doubt.text, DoubtWarning if doubt.grave else CloseRangeWarning, stacklevel=2)
    flags = observed.flags | found | (0 if rig.trusted else int(Flag.untrusted))
    defined = all_finite(solution.xyz_mm, 1)
    return Positions(
        placement=observed.placement,
        reading=observed.reading,
        point=observed.point,
        xyz_mm=solution.xyz_mm,
        cov_mm2=solution.image_cov_mm2 + solution.calibration_cov_mm2,
        residual_px=np.where(defined, rms, np.nan),
        cameras=observed.used.sum(axis=1),
        flags=flags,
        dof=_dof(rig, observed),
        noise_cov_mm2=_noise(observed, solution),
        doubt=doubt.text if doubt is not None and doubt.grave else "",
    )


def _rms(observed: Observed, solution: Solution) -> FloatArray:
    """Return the residual of each point: root of the mean square over the views that take part."""
    squares = np.where(observed.used[:, :, None], solution.residual_px, 0.0) ** 2
    used = observed.used.sum(axis=1)
    rms: FloatArray = np.sqrt(squares.sum(axis=(1, 2)) / np.maximum(2 * used, 1))
    return rms


def _dof(rig: Rig, observed: Observed) -> int | None:
    """Return how well the variance is known: as well as that of the residuals it comes from.

    Where tau fills up what was stated to the variance that the calibration's residuals showed,
    the sum is as uncertain as that variance; where it is 0 the statements stand on their own.
    """
    if (observed.own_cov and rig.tau_px == 0) or rig.dof < 1:
        return None
    return rig.dof


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
    # a view without a residual did not take part in the answer, whatever the answer looks like
    lost = (used & ~all_finite(solution.residual_px, 2)).any(axis=1)
    explained = behind | (parallel & ~all_finite(xyz, 1))
    unfinished = ~too_few & lost & ~explained
    flags = np.zeros(len(xyz), dtype=np.int64)
    for rows, flag in (
        (too_few, Flag.single_view),
        (parallel, Flag.near_parallel),
        (behind, Flag.behind_camera),
        (unfinished, Flag.not_converged),
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

    misfit = max(rig.noise_px**2 - rig.tau_px**2, 0.0)  # tau is in the points' covariance already
    cov = observed.cov_px2 + solution.predicted_px2 + misfit * np.eye(2)
    known = positive_definite(cov.reshape(-1, 2, 2)).reshape(observed.used.shape)
    used = observed.used & all_finite(solution.residual_px, 2) & known
    cov = np.where(used[..., None, None], cov, np.eye(2))
    residual = np.where(used[..., None], solution.residual_px, 0.0)
    squared = np.einsum("mci,mci->m", residual, np.linalg.solve(cov, residual[..., None])[..., 0])
    dof = 2 * used.sum(axis=1) - 3
    limit = chi2.isf(RESIDUAL_FALSE_ALARM, np.maximum(dof, 1))
    return np.asarray((dof > 0) & (squared > limit))


def _doubt(
    rig: Rig, points: ImagePoints, observed: Observed, found: IntArray, rms_px: FloatArray
) -> Doubt | None:
    """Ask whether the points that should be measurable contradict the rig."""
    contradicts = _contradicts(observed, found)
    rows = contradicts & np.isfinite(rms_px)
    return find_doubt(
        rig,
        points,
        contradicts[_measurable(observed)],
        float(np.median(rms_px[rows])) if rows.any() else np.nan,
        _contradictions,
    )


def _contradictions(rig: Rig, points: ImagePoints) -> BoolArray:
    """Tell which measurable points contradict the rig."""
    observed = _without_disc_bias(rig, arrange(rig, points))
    solution = solve_points(rig, observed.xy_px, observed.cov_px2, observed.used)
    contradicts = _contradicts(observed, _geometry_flags(rig, observed, solution))
    return contradicts[_measurable(observed)]


def _measurable(observed: Observed) -> BoolArray:
    """Tell which points two views see of which nothing says that they are displaced."""
    displaced = (observed.flags & int(EXCLUDING)) != 0
    return np.asarray((observed.used.sum(axis=1) >= 2) & ~displaced)


def _contradicts(observed: Observed, found: IntArray) -> BoolArray:
    return np.asarray(_measurable(observed) & ((found & int(CONTRADICTING)) != 0))
