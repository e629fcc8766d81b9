"""Triangulation: exact on exact data, its covariance against sampling."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from closerange.position.triangulate import refine, solve_points, triangulate_linear
from closerange.rig.distortion import BrownIdeal, BrownObserved
from closerange.verification.bound import BROWN
from closerange.verification.scenes import SyntheticRig, control_grid, looking_at_origin

LENSES = {
    "none": BrownIdeal(),
    "ideal": BrownIdeal(k1=-0.2, k2=0.05, p1=0.002, p2=-0.001, k3=0.01),
    # corrections of some px at 600 px from the centre
    "observed": BrownObserved(
        k1=2e-8, k2=1e-14, p1=1e-6, p2=-2e-6, centre_px=(639.5, 511.5), unit_px=(1.0, 1.0)
    ),
}
VOLUME = np.array([[-60.0] * 3, [60.0] * 3])
RNG = np.random.default_rng(11)


def rig_of(count, lens="ideal", noise_px=0.05):
    cameras = tuple(
        looking_at_origin(
            f"c{i}",
            angle_rad=0.35 * (i - 1),
            distance_mm=500 + 40 * i,
            focal_px=1800.0 + 50 * i,
            centre_offset_px=(7.0, -4.0),
            distortion=LENSES[lens],
        )
        for i in range(count)
    )
    return SyntheticRig("test", cameras, VOLUME, noise_px).true_rig()


def seen_by(rig, xyz):
    return np.stack([camera.project(xyz) for camera in rig.cameras], axis=1)


def white(rig, shape):
    return np.broadcast_to(rig.noise_px**2 * np.eye(2), (*shape, 2, 2))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("count", [2, 3])
def test_exact_image_points_give_exact_positions(count, lens):
    rig = rig_of(count, lens)
    xyz = RNG.uniform(*VOLUME, (40, 3))
    px = seen_by(rig, xyz)
    used = np.ones(px.shape[:2], dtype=bool)
    linear = triangulate_linear(rig, px, used)
    solution = solve_points(rig, px, white(rig, used.shape), used)
    # measured 2e-13 mm for both
    assert np.abs(linear - xyz).max() < 1e-9
    assert np.abs(solution.xyz_mm - xyz).max() < 1e-9
    assert np.abs(solution.residual_px).max() < 1e-9


def test_linear_solution_is_opencv_s_on_cameras_without_lens():
    rig = rig_of(2, "none")
    xyz = RNG.uniform(*VOLUME, (40, 3))
    px = seen_by(rig, xyz)
    first, second = (camera.projection_matrix for camera in rig.cameras)
    homogeneous = cv2.triangulatePoints(first, second, px[:, 0].T, px[:, 1].T)
    other = (homogeneous[:3] / homogeneous[3]).T
    ours = triangulate_linear(rig, px, np.ones((40, 2), dtype=bool))
    np.testing.assert_allclose(ours, other, atol=1e-8)


def test_refinement_is_the_weighted_minimum():
    """SciPy's own search of the weighted residuals, three cameras of unequal noise."""
    rig = rig_of(3)
    xyz = RNG.uniform(*VOLUME, (3, 3))
    px = seen_by(rig, xyz) + RNG.normal(0, 0.5, (3, 3, 2))
    root = RNG.normal(size=(3, 3, 2, 2)) + 2 * np.eye(2)
    cov = root @ np.swapaxes(root, 2, 3)
    used = np.ones((3, 3), dtype=bool)
    ours = refine(rig, triangulate_linear(rig, px, used), px, cov, used)
    whitener = np.linalg.inv(np.linalg.cholesky(cov))
    for row in range(3):

        def misfit(x, row=row):
            residual = px[row] - seen_by(rig, x[None])[0]
            return np.einsum("cij,cj->ci", whitener[row], residual).ravel()

        best = least_squares(misfit, xyz[row], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        np.testing.assert_allclose(ours[row], best.x, atol=1e-6)  # measured 9e-9 mm


def test_covariance_of_the_image_part_is_what_noise_makes():
    rig = rig_of(3)
    xyz = np.array([[30.0, -20.0, 40.0]])
    draws = 400
    px = seen_by(rig, xyz) + np.random.default_rng(3).normal(0, rig.noise_px, (draws, 3, 2))
    used = np.ones((draws, 3), dtype=bool)
    solution = solve_points(rig, px, white(rig, used.shape), used)
    error = solution.xyz_mm - xyz
    cov = solution.image_cov_mm2.mean(axis=0)
    # e' V^-1 e has mean 3 and variance 6: the mean of 400 draws scatters by 0.12
    square = np.einsum("mi,ij,mj->m", error, np.linalg.inv(cov), error)
    assert square.mean() == pytest.approx(3, abs=4 * 0.12)
    # a standard deviation from 400 draws is known to 3.5 %; measured within 3.6 %
    np.testing.assert_allclose(error.std(axis=0), np.sqrt(np.diag(cov)), rtol=0.14)
    assert (np.abs(error.mean(axis=0)) < 4 * np.sqrt(np.diag(cov) / draws)).all()
    assert (solution.calibration_cov_mm2 == 0).all()


def uncertain_rig(count=2):
    """A rig whose parameters have the covariance of a calibration from 63 points."""
    rig = rig_of(count)
    control = control_grid(63, 110.0).xyz_mm
    size = len(BROWN)
    cov = np.zeros((count * size, count * size))
    for i, camera in enumerate(rig.cameras):
        block = slice(i * size, (i + 1) * size)
        rows = camera.parameter_jacobian(control, BROWN).reshape(-1, size)
        cov[block, block] = rig.noise_px**2 * np.linalg.inv(rows.T @ rows)
    names = [f"{camera.name}.{name}" for camera in rig.cameras for name in BROWN]
    return replace(rig, parameters=tuple(names), parameter_cov=cov)


def test_covariance_of_the_calibration_part_is_what_wrong_parameters_make():
    rig = uncertain_rig()
    xyz = np.array([[30.0, -20.0, 40.0]])
    px = seen_by(rig, xyz)
    used = np.ones((1, 2), dtype=bool)
    cov = white(rig, used.shape)
    predicted = solve_points(rig, px, cov, used).calibration_cov_mm2[0]
    rng, errors = np.random.default_rng(4), []
    for change in rng.multivariate_normal(np.zeros(len(rig.parameters)), rig.parameter_cov, 400):
        moved = tuple(
            camera.moved(dict(zip(BROWN, part, strict=True)))
            for camera, part in zip(rig.cameras, np.split(change, 2), strict=True)
        )
        wrong = replace(rig, cameras=moved)
        errors.append((solve_points(wrong, px, cov, used).xyz_mm - xyz)[0])
    errors = np.array(errors)
    # as above: 400 draws know a standard deviation to 3.5 %; measured within 5.3 %
    np.testing.assert_allclose(errors.std(axis=0), np.sqrt(np.diag(predicted)), rtol=0.14)
    square = np.einsum("mi,ij,mj->m", errors, np.linalg.inv(predicted), errors)
    assert square.mean() == pytest.approx(3, abs=4 * 0.12)


def test_correlated_cameras_are_propagated_together():
    """An error that both cameras share as a shift of the world moves the point by that shift."""
    rig = rig_of(2)
    names = [f"{camera.name}.{name}" for camera in rig.cameras for name in ("tx", "ty", "tz")]
    # camera_from_world translation of a world shifted by d: t + R d
    both = np.concatenate([camera.camera_from_world.rotation for camera in rig.cameras])
    shift = np.diag([0.1, 0.2, 0.3]) ** 2
    rig = replace(rig, parameters=tuple(names), parameter_cov=both @ shift @ both.T)
    px = seen_by(rig, np.array([[10.0, 5.0, -20.0]]))
    used = np.ones((1, 2), dtype=bool)
    solution = solve_points(rig, px, white(rig, (1, 2)), used)
    np.testing.assert_allclose(solution.calibration_cov_mm2[0], shift, atol=1e-10)


def test_points_of_one_view_are_nan_and_leave_the_others():
    rig = rig_of(3)
    xyz = RNG.uniform(*VOLUME, (3, 3))
    px = seen_by(rig, xyz)
    used = np.array([[True, True, True], [False, True, False], [False, False, False]])
    px[~used] = np.nan
    solution = solve_points(rig, px, white(rig, used.shape), used)
    np.testing.assert_allclose(solution.xyz_mm[0], xyz[0], atol=1e-9)
    assert np.isnan(solution.xyz_mm[1:]).all()
    assert np.isnan(solution.image_cov_mm2[1:]).all()
    assert np.isnan(solution.residual_px[~used]).all()


def test_third_camera_shrinks_the_covariance():
    rig = rig_of(3)
    px = seen_by(rig, np.zeros((2, 3)))
    used = np.array([[True, True, True], [True, True, False]])
    cov = solve_points(rig, px, white(rig, used.shape), used).image_cov_mm2
    gain = np.linalg.eigvalsh(cov[1] - cov[0])
    assert gain[0] > -1e-12  # along its own ray a camera knows nothing
    assert (gain[1:] > 1e-5).all()


@pytest.mark.parametrize("seed", range(5))
def test_gross_noise_never_crashes(seed):
    rig = rig_of(3)
    rng = np.random.default_rng(seed)
    px = rng.uniform([0, 0], [1280, 1024], (50, 3, 2))
    used = rng.random((50, 3)) < 0.8
    solution = solve_points(rig, np.where(used[..., None], px, np.nan), white(rig, (50, 3)), used)
    assert solution.xyz_mm.shape == (50, 3)
