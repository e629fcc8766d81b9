"""What stated covariances leave out: found by the calibration, used when measuring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.features.control import ControlPoints
from closerange.geometry.covariance import mahalanobis_squared, region_limit
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.position.measure import measure_points
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.distortion import BrownIdeal
from closerange.rig.free_poses import calibrate_free_poses
from closerange.verification.error_map import predict_errors
from closerange.verification.scenes import (
    NOISE_PX,
    control_grid,
    observe,
    random_positions,
    rig_a,
    rig_b,
)

STATED_PX = NOISE_PX / 10


def stated(points, std_px=STATED_PX):
    cov = np.broadcast_to(std_px**2 * np.eye(2), (len(points), 2, 2))
    return replace(points, cov_px2=cov)


def sizes_of(scene):
    return {camera.name: camera.size_px for camera in scene.cameras}


def calibrated(scene, *, seed=0, std_px=STATED_PX, model="brown", misplaced_mm=0.0, std_mm=0.0):
    """Calibrate from 63 points, of which detection states `std_px` and the print `std_mm`."""
    rng = np.random.default_rng(seed)
    known = control_grid(63)
    true = known.xyz_mm + misplaced_mm * rng.standard_normal(known.xyz_mm.shape)
    points = observe(scene.cameras, ControlPoints.of(known.point, true), noise_px=NOISE_PX, rng=rng)
    control = ControlPoints.of(known.point, known.xyz_mm, std_mm=std_mm)
    if std_px is not None:
        points = stated(points, std_px)
    return calibrate_rig(points, control, sizes_of(scene), model=model)


@pytest.mark.parametrize("model", ["brown", "pinhole", "dlt"])
def test_what_is_not_stated_is_found_whatever_the_method(model):
    lensless = tuple(replace(camera, distortion=BrownIdeal()) for camera in rig_b().cameras)
    scene = replace(rig_b(), cameras=lensless)
    tau = calibrated(scene, model=model).tau_px
    # 220 degrees of freedom: 4.8 % standard error
    assert tau == pytest.approx(np.sqrt(NOISE_PX**2 - STATED_PX**2), rel=0.15)


def test_nothing_is_added_to_true_statements_or_where_nothing_is_stated():
    assert calibrated(rig_b(), std_px=3 * NOISE_PX).tau_px == 0.0
    assert calibrated(rig_b(), std_px=NOISE_PX, seed=1).tau_px < 0.5 * NOISE_PX
    assert calibrated(rig_b(), std_px=None).tau_px == 0.0


def test_print_errors_are_a_part_of_it_unless_their_size_is_stated():
    """0.05 mm are 0.19 px at 350 mm: four times the noise."""
    scene = rig_b()
    blamed = calibrated(scene, misplaced_mm=0.05)
    separated = calibrated(scene, misplaced_mm=0.05, std_mm=0.05)
    assert blamed.tau_px > 2.5 * NOISE_PX
    assert separated.tau_px < 2.0 * NOISE_PX


def test_free_poses_find_it_too():
    rng, scene = np.random.default_rng(2), rig_b()
    plate = control_grid((5, 5, 1), (80.0, 80.0, 0.0))
    points = None
    for i in range(6):
        turn = rotation_from_vector(rng.normal(0, 0.35, 3))
        world = RigidTransform(turn, rng.normal(0, 15, 3)).apply(plate.xyz_mm)
        placed = ControlPoints.of(plate.point, world, placement=f"p{i}")
        seen = stated(observe(scene.cameras, placed, noise_px=NOISE_PX, rng=rng))
        points = seen if points is None else points + seen
    rig = calibrate_free_poses(points, plate, sizes_of(scene))
    assert rig.tau_px == pytest.approx(NOISE_PX, rel=0.15)


@pytest.mark.parametrize("scene", [rig_a(), rig_b()], ids=lambda scene: scene.name)
def test_positions_of_points_that_state_too_little_hold_their_covariance(scene):
    """The worst case of the review: a tenth of the true noise is stated."""
    inside, ratios = [], []
    for seed in range(5):
        rig = calibrated(scene, seed=seed)
        rng = np.random.default_rng(100 + seed)
        truth = random_positions(200, scene.volume_mm, rng)
        points = stated(observe(scene.cameras, truth, noise_px=NOISE_PX, rng=rng))
        positions = measure_points(rig, points)
        assert np.count_nonzero(positions.flags) <= 1  # near a face, by more than three sigma
        assert positions.dof == rig.dof
        square = mahalanobis_squared(positions.xyz_mm - truth.xyz_mm, positions.cov_mm2)
        inside.append(np.mean(square <= region_limit(3, positions.dof)))
        ratios.append(square.mean() / 3)
    # measured 0.95 and 0.95, 1.0 and 1.0; without tau 0.20 and 12
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_the_trust_prediction_and_the_positions_agree():
    scene = rig_b()
    rig = calibrated(scene)
    truth = random_positions(300, scene.volume_mm, np.random.default_rng(3))
    points = stated(observe(scene.cameras, truth, noise_px=NOISE_PX, rng=np.random.default_rng(4)))
    std = np.sqrt(np.mean(np.einsum("mii->mi", measure_points(rig, points).cov_mm2), axis=0))
    predicted = np.sqrt(np.nanmean(predict_errors(rig).std_mm ** 2, axis=0))
    # the map weighs corners and faces more than random positions: within 15 %
    assert std == pytest.approx(predicted, rel=0.15)


def test_noise_between_readings_stays_what_was_stated():
    scene = rig_b()
    rig = calibrated(scene)
    truth = random_positions(5, scene.volume_mm, np.random.default_rng(5))
    points = stated(observe(scene.cameras, truth, noise_px=0.0, rng=np.random.default_rng(0)))
    points = replace(points, noise_cov_px2=points.cov_px2)
    with_tau = measure_points(rig, points)
    without = measure_points(replace(rig, tau_px=0.0), points)
    np.testing.assert_allclose(with_tau.noise_cov_mm2, without.noise_cov_mm2, rtol=1e-6)
    assert (
        np.trace(with_tau.cov_mm2, axis1=1, axis2=2)
        > 10 * np.trace(with_tau.noise_cov_mm2, axis1=1, axis2=2)
    ).all()
