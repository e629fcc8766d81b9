"""One camera: starts, convergence, derivatives, covariance; OpenCV as the independent witness."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from closerange.errors import GeometryError
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import analyse, fit_camera
from closerange.rig.camera_start import affine_starts
from closerange.rig.distortion import BrownIdeal, BrownObserved
from closerange.rig.models import FREE, MODELS, model_named
from closerange.rig.projector import PARAMETERS, Projector
from closerange.rig.view import View
from closerange.verification.scenes import (
    control_grid,
    looking_at_origin,
    rig_a,
    rig_b,
    strong_lens_rig,
)

BROWN = FREE["brown"]
NOISE_PX = 0.05


def seen(camera: Camera, xyz_mm, rng=None, noise_px=NOISE_PX) -> View:
    xy = camera.project(xyz_mm)
    known = np.isfinite(xy).all(axis=1)
    noise = 0.0 if rng is None else rng.normal(0, noise_px, xy.shape)
    return View(camera.name, camera.size_px, xyz_mm[known], (xy + noise)[known])


def test_inner_loop_agrees_with_the_camera():
    camera = rig_b().cameras[0].moved({"skew": 3.0, "k3": 0.02})
    view = seen(camera, control_grid(27).xyz_mm + np.array([5.0, 7.0, -3.0]))
    projector = Projector(view, camera)
    residual, jacobian = projector.evaluate(*projector.values())
    assert np.abs(residual).max() < 1e-9
    # the camera's own Jacobian in the centred frame, itself checked by finite differences
    middle = view.xyz_mm.mean(axis=0)
    pose = camera.camera_from_world
    centred = replace(camera, camera_from_world=RigidTransform(pose.rotation, pose.apply(middle)))
    expected = centred.parameter_jacobian(view.xyz_mm - middle, PARAMETERS)
    error = np.abs(np.moveaxis(jacobian, 2, 0).swapaxes(1, 2) - expected)
    assert (error <= 1e-10 * (1 + np.abs(expected))).all()


def test_inner_loop_takes_no_other_lens():
    camera = replace(rig_b().cameras[0], distortion=BrownObserved())
    with pytest.raises(TypeError, match="BrownObserved"):
        Projector(seen(camera, control_grid(27).xyz_mm), camera)


@pytest.mark.parametrize("points", [27, 63, 343])
@pytest.mark.parametrize("scene", [rig_a, rig_b, strong_lens_rig], ids=["A", "B", "strong"])
def test_exact_data_give_the_exact_camera(scene, points):
    for camera in scene().cameras:
        view = seen(camera, control_grid(points).xyz_mm)
        fit = fit_camera(view, BROWN)
        assert fit.converged
        assert np.abs(fit.residual_px).max() < 1e-6
        assert fit.camera.matrix_px == pytest.approx(camera.matrix_px, abs=0.01)


@pytest.mark.parametrize("scene", [rig_a, rig_b, strong_lens_rig], ids=["A", "B", "strong"])
def test_the_start_does_not_matter(scene):
    rng = np.random.default_rng(3)
    for camera in scene().cameras:
        view = seen(camera, control_grid(125).xyz_mm, rng)
        found, best = fit_camera(view, BROWN), fit_camera(view, BROWN, camera)
        assert found.converged
        assert found.chi_square == pytest.approx(best.chi_square, rel=1e-9)


def test_nearly_affine_block_of_the_thesis():
    """A 12.7 mm block at 0.6 m: 4 px of perspective, 0.1 px of noise."""
    rng = np.random.default_rng(1)
    camera = looking_at_origin(
        "t", angle_rad=0.3, distance_mm=600.0, focal_px=14000.0, size_px=(640, 480)
    )
    xyz = control_grid((3, 3, 6), 12.7).xyz_mm
    for _ in range(5):
        view = seen(camera, xyz, rng, 0.1)
        for free in (FREE["pinhole"], BROWN):
            fit = fit_camera(view, free)
            noise = np.sqrt(fit.rss_px2 / fit.dof)
            assert fit.converged
            assert noise == pytest.approx(0.1, rel=0.3)  # 94 dof: 7 % standard deviation


def test_affine_start_survives_where_the_lens_is_strong():
    camera = strong_lens_rig().cameras[0]
    view = seen(camera, control_grid(343).xyz_mm)
    start = affine_starts(view)[0]
    turn = start.camera_from_world.rotation @ camera.camera_from_world.rotation.T
    assert np.degrees(np.arccos((np.trace(turn) - 1) / 2)) < 20
    assert (start.depth_mm(view.xyz_mm) > 0).all()


def test_same_as_opencv():
    rng = np.random.default_rng(5)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    for camera in (*rig_b().cameras, strong_lens_rig().cameras[0]):
        view = seen(camera, control_grid(63).xyz_mm, rng)
        fit = fit_camera(view, BROWN)
        _, matrix, lens, turns, shifts = cv2.calibrateCamera(
            [view.xyz_mm.astype(np.float32)],
            [view.xy_px.astype(np.float32)],
            camera.size_px,
            camera.matrix_px.copy(),
            np.zeros(5),
            flags=flags,
            criteria=stop,
        )
        theirs = cv2.projectPoints(view.xyz_mm, turns[0], shifts[0], matrix, lens)[0]
        assert np.abs(theirs.reshape(-1, 2) - fit.camera.project(view.xyz_mm)).max() < 1e-4


def test_a_frame_100_m_away_loses_no_digits():
    rng = np.random.default_rng(7)
    camera = rig_b().cameras[0]
    near = seen(camera, control_grid(63).xyz_mm, rng)
    offset = np.array([1e5, -1e5, 1e5])
    far = View(near.name, near.size_px, near.xyz_mm + offset, near.xy_px)
    a, b = fit_camera(near, BROWN), fit_camera(far, BROWN)
    assert np.abs(a.residual_px - b.residual_px).max() < 1e-6
    assert b.camera.centre_mm - offset == pytest.approx(a.camera.centre_mm, abs=1e-4)
    # the lens' covariance knows nothing of the frame; the translation's grows with the lever arm
    assert np.diag(b.cofactor)[:8] == pytest.approx(np.diag(a.cofactor)[:8], rel=1e-4)
    step = b.camera.project_jacobian(far.xyz_mm[:1])
    assert np.isfinite(step).all()


def test_covariance_is_about_the_world_origin():
    """Predicted pixel covariance by the camera's own Jacobian equals the centred hat matrix."""
    camera = rig_a().cameras[0]
    view = seen(camera, control_grid(27).xyz_mm + np.array([300.0, -200.0, 40.0]))
    fit = fit_camera(view, BROWN)
    jacobian = fit.camera.parameter_jacobian(view.xyz_mm, BROWN)
    predicted = jacobian @ fit.cofactor @ np.swapaxes(jacobian, 1, 2)
    hat = np.einsum("nip,njp->nij", fit.orthonormal, fit.orthonormal)
    assert np.abs(predicted - hat).max() < 1e-6


def test_weights_are_those_of_scaled_equations():
    rng = np.random.default_rng(9)
    view = seen(rig_b().cameras[0], control_grid(27).xyz_mm, rng)
    whitener = np.tile([1.0, 0.0, 1.0], (len(view), 1))
    whitener[:9] *= 2.0  # as if these had been seen four times
    twice = View(
        view.name,
        view.size_px,
        np.concatenate([view.xyz_mm, *[view.xyz_mm[:9]] * 3]),
        np.concatenate([view.xy_px, *[view.xy_px[:9]] * 3]),
    )
    weighted, repeated = fit_camera(view.weighted(whitener), BROWN), fit_camera(twice, BROWN)
    assert weighted.camera.matrix_px == pytest.approx(repeated.camera.matrix_px, abs=1e-5)
    assert weighted.cofactor == pytest.approx(repeated.cofactor, rel=1e-5, abs=1e-12)


def test_any_lens_can_be_analysed():
    rng = np.random.default_rng(11)
    view = seen(rig_b().cameras[0], control_grid(63).xyz_mm, rng)
    fit = fit_camera(view, FREE["pinhole"])
    other = replace(fit.camera, distortion=BrownObserved())
    same = analyse(view, other, FREE["pinhole"])
    assert same.residual_px == pytest.approx(fit.residual_px, abs=1e-9)
    assert same.cofactor == pytest.approx(fit.cofactor, rel=1e-6, abs=1e-12)


def test_planar_points_are_refused():
    view = seen(rig_a().cameras[0], control_grid((5, 5, 1)).xyz_mm)
    with pytest.raises(GeometryError, match="one plane"):
        fit_camera(view, BROWN)


def test_indistinct_parameters_are_named():
    camera = rig_b().cameras[0]
    xyz = control_grid(27).xyz_mm
    view = seen(camera, xyz)
    with pytest.raises(GeometryError, match=r"cannot tell .*k3.* apart"):
        # all points at one radius from the axis: k1, k2, k3 are one number
        analyse(_ring(camera), replace(camera, distortion=BrownIdeal()), FREE["brown-k3"])
    with pytest.raises(GeometryError, match="7 points give 14 numbers for 14 parameters"):
        fit_camera(view.select(np.arange(len(view)) < 7), BROWN)


def _ring(camera: Camera) -> View:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    depth = np.tile([330.0, 350.0, 370.0, 390.0], 3)
    in_camera = np.stack([0.2 * np.cos(angle) * depth, 0.2 * np.sin(angle) * depth, depth], axis=1)
    xyz = camera.camera_from_world.inverse().apply(in_camera)
    straight = replace(camera, distortion=BrownIdeal())
    return View(camera.name, camera.size_px, xyz, straight.project(xyz))


def test_models_state_what_they_free_and_why_not():
    assert set(model_named("brown").free) == {
        *("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
        *("rx", "ry", "rz", "tx", "ty", "tz"),
    }
    for name in MODELS[1:]:
        model = model_named(name)
        assert not set(model.free) & set(model.fixed)
        assert set(model.free) | set(model.fixed) == set(PARAMETERS)
    with pytest.raises(ValueError, match="model 'browne' is not known"):
        model_named("browne")


def test_real_step_block(shared):
    """MyPTV's machined block, 1280x1024, seen from Z = +550: residuals as its README states."""
    folder = shared / "data" / "myptv-step-block"
    for number, stated in ((1, 0.219), (2, 0.490), (3, 0.518)):
        table = np.genfromtxt(folder / f"points_cam{number}.csv", delimiter=",", names=True)
        xyz = np.stack([table["X"], table["Y"], table["Z"]], axis=1)
        xy = np.stack([table["x"], table["y"]], axis=1)
        fit = fit_camera(View(f"cam{number}", (1280, 1024), xyz, xy), BROWN)
        assert fit.converged
        rms = np.sqrt(np.mean(np.sum(fit.residual_px**2, axis=1)))
        assert rms == pytest.approx(stated, abs=0.002)
        assert fit.camera.centre_mm[2] == pytest.approx(565, abs=25)
