"""The Cramer-Rao bound against the calibration report and against an independent fit."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from closerange.errors import GeometryError
from closerange.verification.bound import BROWN, position_bound, rms_3d_mm
from closerange.verification.scenes import (
    control_grid,
    looking_at_origin,
    random_positions,
    rig_a,
    rig_b,
)


@pytest.mark.parametrize(
    ("rig", "count", "total_um", "calibration_um"),
    [
        (rig_a(), 27, 39.3, 15.8),
        (rig_a(), 63, 37.6, 10.8),
        (rig_b(), 27, 35.1, 13.4),
        (rig_b(), 63, 33.7, 9.16),
    ],
)
def test_bound_is_that_of_the_calibration_report(rig, count, total_um, calibration_um):
    held_out = random_positions(400, rig.volume_mm, np.random.default_rng(0)).xyz_mm
    total, calibration = position_bound(
        rig.cameras, BROWN, control_grid(count).xyz_mm, held_out, 0.05
    )
    # the report drew other held-out points: 400 of them scatter the mean by about 1 %
    assert 1000 * rms_3d_mm(total) == pytest.approx(total_um, rel=0.02)
    assert 1000 * rms_3d_mm(calibration) == pytest.approx(calibration_um, rel=0.03)


def test_bound_is_what_an_independent_fit_scatters_by():
    """Rig B, 27 points: SciPy's fit of OpenCV's own projection, calibration part."""
    rig, control = rig_b(), control_grid(27).xyz_mm
    held_out = random_positions(40, rig.volume_mm, np.random.default_rng(3)).xyz_mm
    rng = np.random.default_rng(4)
    runs = 40
    errors = np.zeros((runs, 40, 3))
    by_position = np.concatenate([c.project_jacobian(held_out) for c in rig.cameras], axis=1)
    solve = np.linalg.pinv(by_position)
    for run in range(runs):
        moved = []
        for camera in rig.cameras:
            exact = camera.project(control)
            fit = _fit_by_scipy(camera, control, exact + 0.05 * rng.standard_normal(exact.shape))
            # noise-free held-out pixels, read with wrong parameters: first order in the change
            moved.append(camera.project(held_out) - _opencv(fit, held_out))
        shift = np.stack(moved, axis=1).reshape(len(held_out), -1)
        errors[run] = np.einsum("nij,nj->ni", solve, shift)
    _, calibration = position_bound(rig.cameras, BROWN, control, held_out, 0.05)
    ratio = np.sqrt((errors**2).sum(axis=2).mean()) / rms_3d_mm(calibration)
    # 40 runs of 28 parameters: the standard error of the ratio is about 1 / sqrt(2 * 40 * 10)
    assert ratio == pytest.approx(1.0, abs=0.12)
    along = (errors**2).mean(axis=(0, 1)) / np.einsum("nii->ni", calibration).mean(axis=0)
    assert np.sqrt(along) == pytest.approx(np.ones(3), abs=0.2)


def test_coplanar_control_does_not_bound_anything():
    """One homography has 8 numbers; 4 of the camera and 6 of the pose do not follow from it."""
    camera = looking_at_origin("c", angle_rad=0.4, distance_mm=350, focal_px=1300)
    names = [name for name in BROWN if name not in ("k1", "k2", "p1", "p2")]
    cameras, somewhere = (camera, rig_b().cameras[1]), [[10.0, 5.0, -20.0]]
    with pytest.raises(GeometryError, match="do not fix"):
        position_bound(cameras, names, control_grid((5, 5, 1)).xyz_mm, somewhere, 0.05)
    bound = position_bound(cameras, names, control_grid(27).xyz_mm, somewhere, 0.05)
    assert np.isfinite(bound).all()


def test_too_few_points_are_refused():
    with pytest.raises(GeometryError, match="8 image coordinates cannot fix 14"):
        position_bound(
            rig_b().cameras, BROWN, control_grid((2, 2, 1)).xyz_mm, np.zeros((1, 3)), 0.05
        )


def test_more_points_lower_the_calibration_part_alone():
    rig = rig_a()
    held_out = random_positions(20, rig.volume_mm, np.random.default_rng(5)).xyz_mm
    few, many = (
        position_bound(rig.cameras, BROWN, control_grid(n).xyz_mm, held_out, 0.05)
        for n in (27, 2000)
    )
    assert rms_3d_mm(many[1]) < rms_3d_mm(few[1]) / 5
    assert np.allclose(few[0] - few[1], many[0] - many[1], rtol=1e-9)


def _fit_by_scipy(camera, control, seen):
    """Fit fx fy cx cy k1 k2 p1 p2 and the pose, from the truth, with SciPy's own derivatives."""
    pose, lens = camera.camera_from_world, camera.distortion
    start = np.concatenate(
        [
            camera.matrix_px[[0, 1, 0, 1], [0, 1, 2, 2]],
            [lens.k1, lens.k2, lens.p1, lens.p2],
            cv2.Rodrigues(np.array(pose.rotation))[0].ravel(),
            pose.translation_mm,
        ]
    )
    scale = np.array([100.0] * 4 + [0.1, 0.1, 0.01, 0.01] + [0.1] * 3 + [10.0] * 3)
    fit = least_squares(
        lambda step: (_opencv(start + scale * step, control) - seen).ravel(),
        np.zeros(14),
        method="lm",
        jac="2-point",
    )
    return start + scale * fit.x


def _opencv(parameters, xyz):
    fx, fy, cx, cy = parameters[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(xyz, parameters[8:11], parameters[11:14], matrix, parameters[4:8])
    return pixels.reshape(-1, 2)
