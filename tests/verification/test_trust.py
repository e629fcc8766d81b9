"""The trust verdict: good rigs are good, weak ones are told why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, GeometryError
from closerange.rig.calibrate import calibrate_rig
from closerange.verification.error_map import predict_errors
from closerange.verification.scenes import control_grid, observe, rig_a, rig_b
from closerange.verification.trust import judge_rig


def calibrated(scene, shape=63, size_mm=150.0, noise_px=0.05, model="brown"):
    control = control_grid(shape, size_mm)
    points = observe(scene.cameras, control, noise_px=noise_px, rng=np.random.default_rng(0))
    sizes = {camera.name: camera.size_px for camera in scene.cameras}
    return calibrate_rig(points, control, sizes, model=model)


@pytest.mark.parametrize("count", [27, 63])
@pytest.mark.parametrize("scene", [rig_a(), rig_b()], ids=lambda scene: scene.name)
def test_an_ordinary_rig_is_good(scene, count):
    trust = judge_rig(calibrated(scene, count))
    assert trust.verdict == "good"
    assert trust.reasons == ()
    # noise 0.05 px is 16 um (A) or 13 um (B) in the scene; depth is about 3 times worse
    assert (trust.predicted_mm[:2] < 0.02).all()
    assert 0.02 < trust.predicted_mm[2] < 0.05
    assert (trust.calibration_mm < trust.predicted_mm).all()


def test_predicted_error_is_the_rms_of_the_map():
    rig = calibrated(rig_b())
    errors = predict_errors(rig)
    trust = judge_rig(rig)
    np.testing.assert_allclose(trust.predicted_mm, np.sqrt(np.mean(errors.std_mm**2, axis=0)))
    np.testing.assert_allclose(
        trust.calibration_mm, np.sqrt(np.mean(errors.calibration_std_mm**2, axis=0))
    )


def test_points_in_one_plane_are_refused():
    with pytest.raises(GeometryError, match="one plane"):
        calibrated(rig_b(), (5, 5, 1))


def test_points_that_are_nearly_in_one_plane_are_not_trusted():
    """0.3 mm thick, as a warped plate is: its own volume would vouch for itself."""
    rig = calibrated(rig_b(), (5, 5, 2), (150.0, 150.0, 0.3), model="pinhole")
    trust = judge_rig(rig)
    assert trust.verdict == "untrustworthy"
    assert "calibration alone" in trust.reasons[0]
    assert "control points" in trust.reasons[0]
    stated = judge_rig(rig, volume_given=True)
    assert (stated.predicted_mm < trust.predicted_mm).all()


def test_a_four_hundred_fold_noise_is_not_trusted():
    """20 px: a wrong pairing of points leaves residuals like these."""
    with pytest.warns(CloseRangeWarning, match="residuals are"):
        rig = calibrated(rig_b(), noise_px=20.0, model="pinhole")
    trust = judge_rig(rig)
    assert trust.verdict == "untrustworthy"
    assert any("limit 1 %" in reason and "named rightly" in reason for reason in trust.reasons)


def test_few_degrees_of_freedom_are_fair_at_best():
    rig = calibrated(rig_a())
    trust = judge_rig(replace(rig, dof=9))
    assert trust.verdict == "fair"
    assert "only 9 degrees of freedom" in trust.reasons[0]
    assert judge_rig(replace(rig, dof=10)).verdict == "good"


def test_a_calibration_worse_than_a_reading_is_fair_then_untrustworthy():
    rig = calibrated(rig_b())
    trust = judge_rig(rig)
    image = np.sqrt(trust.predicted_mm**2 - trust.calibration_mm**2)
    share = (trust.calibration_mm / image).max()  # grows as the root of the covariance
    for wanted, verdict in ((0.95, "good"), (1.05, "fair"), (2.9, "fair"), (3.1, "untrustworthy")):
        scaled = replace(rig, parameter_cov=rig.parameter_cov * (wanted / share) ** 2)
        assert judge_rig(scaled).verdict == verdict


def test_a_fit_that_did_not_converge_is_not_trusted():
    rig = calibrated(rig_b())
    cameras = {**rig.report["cameras"], "left": {"converged": False}}
    trust = judge_rig(replace(rig, report={"cameras": cameras}))
    assert trust.verdict == "untrustworthy"
    assert "camera left: the fit did not converge" in trust.reasons[0]


def test_a_volume_that_the_cameras_do_not_see_is_fair():
    rig = replace(calibrated(rig_b()), volume_mm=np.array([[-400.0] * 3, [400.0, 400, 200]]))
    trust = judge_rig(rig)
    assert trust.verdict != "good"
    assert any("seen by fewer than two cameras" in reason for reason in trust.reasons)


def test_a_volume_that_no_two_cameras_see_is_not_trusted():
    """Nothing can be predicted there, nor measured: a wrong --volume."""
    rig = replace(calibrated(rig_b()), volume_mm=np.array([[900.0, 900, 0], [950.0, 950, 50]]))
    trust = judge_rig(rig, volume_given=True)
    assert trust.verdict == "untrustworthy"
    assert "seen by two cameras" in trust.reasons[0]


def test_one_camera_alone_is_judged_without_a_figure():
    rig = calibrated(rig_b())
    names, places = rig.parameters_of("left")
    alone = replace(
        rig,
        cameras=rig.cameras[:1],
        parameters=tuple(f"left.{name}" for name in names),
        parameter_cov=rig.parameter_cov[np.ix_(places, places)],
    )
    trust = judge_rig(alone)
    assert trust.verdict == "fair"
    assert np.isnan(trust.predicted_mm).all()
    assert trust.reasons[0].startswith("one camera: no positions")
    assert not any("seen by fewer than two" in reason for reason in trust.reasons)
    assert str(trust) == "fair: no positions, hence no predicted error"


def test_an_infinite_covariance_is_not_trusted():
    rig = calibrated(rig_b())
    cov = rig.parameter_cov.copy()
    cov[0, 0] = np.inf
    trust = judge_rig(replace(rig, parameter_cov=cov))
    assert trust.verdict == "untrustworthy"
    assert "not finite" in trust.reasons[0]


@pytest.mark.parametrize("noise_px", [0.05, 0.0])
def test_two_cameras_with_the_same_points_are_not_trusted(noise_px):
    """One camera's table under two names: the rays never cross, nothing can be predicted."""
    scene, control = rig_b(), control_grid(27)
    rng = np.random.default_rng(0)
    left = observe(scene.cameras[:1], control, noise_px=noise_px, rng=rng)
    both = left + replace(left, camera=("right",) * len(left))
    sizes = {camera.name: camera.size_px for camera in scene.cameras}
    trust = judge_rig(calibrate_rig(both, control, sizes, model="brown"))
    assert trust.verdict == "untrustworthy"
    assert "images of one camera under several names" in trust.reasons[0]
    assert not any("seen by fewer than two" in reason for reason in trust.reasons)
    assert "nan" not in str(trust)
