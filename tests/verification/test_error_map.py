"""The error that a rig predicts for itself, against the error that it makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.position.measure import measure_points
from closerange.rig.calibrate import calibrate_rig
from closerange.verification.bound import BROWN, position_bound
from closerange.verification.error_map import judged_volume, predict_errors
from closerange.verification.scenes import control_grid, observe, random_positions, rig_a, rig_b


def calibrated(scene, count=63, seed=0):
    control = control_grid(count)
    points = observe(
        scene.cameras, control, noise_px=scene.noise_px, rng=np.random.default_rng(seed)
    )
    sizes = {camera.name: camera.size_px for camera in scene.cameras}
    return calibrate_rig(points, control, sizes, model="brown", reject=False)


def test_nodes_run_in_c_order_over_the_volume():
    rig = rig_b().true_rig()
    errors = predict_errors(rig, np.array([[0.0, 10, 20], [2, 14, 26]]), nodes=3)
    assert errors.shape == (3, 3, 3)
    grid = errors.xyz_mm.reshape(3, 3, 3, 3)
    np.testing.assert_allclose(grid[1, 2, 0], [1, 14, 20])
    own = predict_errors(rig, nodes=2).xyz_mm
    np.testing.assert_allclose([own[0], own[-1]], rig.volume_mm)


def test_without_parameters_only_the_image_errs():
    rig = rig_b().true_rig()
    errors = predict_errors(rig, nodes=3)
    assert (errors.calibration_std_mm == 0).all()
    middle = errors.std_mm.reshape(3, 3, 3, 3)[1, 1, 1]
    # two rays 20 degrees either side of Z, each s * depth / f = 13.5 um across:
    # across the base s / (sqrt(2) cos), along the depth s / (sqrt(2) sin), upwards s / sqrt(2)
    ray = rig.noise_px * 350 / 1300
    expected = ray / np.sqrt(2) / [np.cos(np.radians(20)), 1, np.sin(np.radians(20))]
    np.testing.assert_allclose(middle, expected, rtol=1e-9)  # measured 2e-16


def test_noise_scales_the_prediction():
    rig = rig_b().true_rig()
    one, two = predict_errors(rig, nodes=3), predict_errors(replace(rig, noise_px=0.1), nodes=3)
    np.testing.assert_allclose(two.std_mm, 2 * one.std_mm, rtol=1e-9)


@pytest.mark.parametrize("scene", [rig_a(), rig_b()], ids=lambda scene: scene.name)
def test_prediction_is_the_cramer_rao_bound_of_the_true_rig(scene):
    """The bound is computed from the truth, the prediction from one noisy calibration."""
    rig = calibrated(scene)
    errors = predict_errors(rig, scene.volume_mm, nodes=3)
    total, calibration = position_bound(
        scene.cameras, BROWN, control_grid(63).xyz_mm, errors.xyz_mm, rig.noise_px
    )
    # The noise is the estimated one on both sides; the rest is the parameters' own error.
    # Measured 1.4 % and 7.8 % (A, a nearly affine view), 0.1 % and 0.5 % (B).
    expected = np.sqrt(np.einsum("mii->mi", total))
    np.testing.assert_allclose(errors.std_mm, expected, rtol=0.03)
    expected = np.sqrt(np.einsum("mii->mi", calibration))
    np.testing.assert_allclose(errors.calibration_std_mm, expected, rtol=0.15)


def test_prediction_is_what_repeated_calibrations_scatter_by():
    """Calibrate and measure anew 40 times: corners, faces and middle of the volume."""
    scene = rig_b()
    predicted = predict_errors(calibrated(scene, 27), scene.volume_mm, nodes=3)
    nodes = 0.999 * predicted.xyz_mm  # the corners stay inside the volume
    truth = replace(random_positions(27, scene.volume_mm, np.random.default_rng(0)), xyz_mm=nodes)
    draws = 40
    errors = np.empty((draws, 27, 3))
    for draw in range(draws):
        rig = calibrated(scene, 27, seed=100 + draw)
        rng = np.random.default_rng(500 + draw)
        points = observe(scene.cameras, truth, noise_px=scene.noise_px, rng=rng)
        errors[draw] = measure_points(rig, points).xyz_mm - nodes
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / predicted.std_mm
    # 40 draws know a standard deviation to 11 % and s of the prediction is known to 8 %;
    # measured 1.09 on average, 0.83 to 1.35
    assert ratio.mean() == pytest.approx(1, abs=0.2)
    assert (ratio > 0.5).all()
    assert (ratio < 1.6).all()


def test_what_fewer_than_two_cameras_see_is_nan():
    scene = rig_b()
    rig = scene.true_rig()
    wide = predict_errors(rig, np.array([[-400.0, -10, -10], [400, 10, 10]]), nodes=3)
    seen = np.isfinite(wide.std_mm).all(axis=1).reshape(3, 3, 3)
    assert not seen[[0, 2]].any()
    assert seen[1].all()
    alone = replace(rig, cameras=rig.cameras[:1])
    assert np.isnan(predict_errors(alone, nodes=2).std_mm).all()


def test_a_third_view_that_does_not_see_a_node_does_not_count():
    scene = rig_b()
    away = replace(scene.cameras[0].moved({"tx": 1e4}), name="away")
    rig = scene.true_rig()
    three = replace(rig, cameras=(*rig.cameras, away))
    np.testing.assert_allclose(
        predict_errors(three, nodes=2).std_mm, predict_errors(rig, nodes=2).std_mm
    )


def test_thin_sides_are_widened_about_their_middle():
    thin = np.array([[0.0, -50, 9], [100, 50, 11]])
    np.testing.assert_allclose(judged_volume(thin), [[0, -50, -2.5], [100, 50, 22.5]])
    cube = np.array([[-75.0] * 3, [75.0] * 3])
    np.testing.assert_allclose(judged_volume(cube), cube)
