"""The choice of lens terms: by predicted error, never by residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.rig.calibrate import calibrate_rig
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import fit_camera
from closerange.rig.distortion import BrownIdeal
from closerange.rig.model_choice import DEFAULT, candidates, choose_model, left_out_errors
from closerange.rig.models import FREE
from closerange.rig.view import View
from closerange.verification.scenes import control_grid, observe, rig_a, rig_b, strong_lens_rig

NOISE_PX = 0.05


def views_of(cameras, points, rng) -> list[View]:
    xyz = control_grid(points).xyz_mm
    return [
        View(c.name, c.size_px, xyz, c.project(xyz) + rng.normal(0, NOISE_PX, (len(xyz), 2)))
        for c in cameras
    ]


def choose(cameras, points, seed):
    views = views_of(cameras, points, np.random.default_rng(seed))
    groups = [np.arange(len(view)) for view in views]
    starts = [fit_camera(view, FREE["pinhole"]).camera for view in views]
    return choose_model(views, groups, starts)


def with_lens(lens: BrownIdeal) -> list[Camera]:
    return [replace(camera, distortion=lens) for camera in rig_b().cameras]


def test_left_out_errors_are_those_of_refits():
    """One Gauss-Newton step against refits without each fold; exact as noise goes to zero."""
    rng = np.random.default_rng(1)
    camera = rig_b().cameras[0]
    xyz = control_grid(63).xyz_mm
    noise = 1e-3 * rng.normal(0, 1, (63, 2))
    view = View(camera.name, camera.size_px, xyz, camera.project(xyz) + noise)
    fit = fit_camera(view, FREE["brown"])
    errors = left_out_errors(fit, view, np.arange(63))
    for fold in (0, 7):
        out = np.arange(63) % 10 == fold
        refit = fit_camera(view.select(~out), FREE["brown"])
        miss = view.xy_px[out] - refit.camera.project(xyz[out])
        focal = np.diag(fit.camera.matrix_px)[:2]
        depth = fit.camera.depth_mm(xyz[out])
        expected = np.mean((miss * depth[:, None] / focal) ** 2, axis=1)
        assert errors[out] == pytest.approx(expected, rel=0.02)


def test_whitening_does_not_change_the_unit():
    rng = np.random.default_rng(2)
    view = views_of(rig_b().cameras, 63, rng)[0]
    fit = fit_camera(view, FREE["brown"])
    half = view.weighted(np.tile([2.0, 0.0, 2.0], (63, 1)))
    again = fit_camera(half, FREE["brown"], fit.camera)
    group = np.arange(63)
    assert left_out_errors(again, half, group) == pytest.approx(
        left_out_errors(fit, view, group), rel=1e-4, abs=1e-14
    )


def test_usual_rigs_get_the_default():
    for cameras, points in ((rig_b().cameras, 27), (rig_b().cameras, 63), (rig_a().cameras, 63)):
        chosen = [choose(cameras, points, seed).model for seed in range(12)]
        # the rule lets luck decide once in two hundred choices
        assert chosen.count(DEFAULT) >= 11, chosen


def test_a_needed_k3_is_taken():
    lens = BrownIdeal(k1=-0.3, k2=0.1, k3=0.1)  # k3 moves a corner at radius 0.6 by 2 px
    cameras = [replace(camera, distortion=lens) for camera in strong_lens_rig().cameras]
    choice = choose(cameras, 125, 3)
    assert choice.model == "brown-k3"
    table = {row["model"]: row for row in choice.report["table"]}
    assert table["brown-k3"]["better_by_standard_errors"] > 3


def test_it_is_not_the_residual_that_chooses():
    choice = choose(rig_b().cameras, 63, 4)
    table = {row["model"]: row for row in choice.report["table"]}
    errors = {name: row["cross_validated_mm"] for name, row in table.items()}
    assert errors["brown"] < 0.2 * errors["pinhole"]  # 10 px of distortion
    rich = choose(rig_b().cameras, 27, 5)
    table = {row["model"]: row for row in rich.report["table"]}
    assert choice.model == rich.model == DEFAULT
    assert table["brown-k3"]["parameters_per_camera"] == 15


def test_candidates_by_number_of_points():
    names = {n: [model.name for model in candidates(n)] for n in (6, 8, 10, 11, 27)}
    assert names[6] == []
    assert names[8] == ["pinhole"]
    assert "brown" not in names[10]
    assert names[11][0] == "brown"
    assert names[27][0] == "brown-k3"


def test_few_points_take_the_lowest_error():
    """Nine points cannot afford the default; without distortion lean models must win mostly."""
    rng = np.random.default_rng(6)
    cameras = with_lens(BrownIdeal())
    xyz = rng.uniform(-75, 75, (9, 3))
    views = [
        View(c.name, c.size_px, xyz, c.project(xyz) + rng.normal(0, NOISE_PX, (9, 2)))
        for c in cameras
    ]
    starts = [fit_camera(view, FREE["pinhole"]).camera for view in views]
    choice = choose_model(views, [np.arange(9)] * 2, starts)
    errors = {row["model"]: row["cross_validated_mm"] for row in choice.report["table"]}
    assert choice.model == min(errors, key=lambda name: errors[name])
    assert "brown" not in errors


def test_auto_uses_the_choice():
    scene, control = rig_b(), control_grid(63)
    points = observe(scene.cameras, control, noise_px=NOISE_PX, rng=np.random.default_rng(7))
    size = {camera.name: camera.size_px for camera in scene.cameras}
    rig = calibrate_rig(points, control, size)
    assert rig.model == rig.report["model_choice"]["chosen"] == DEFAULT
    direct = calibrate_rig(points, control, size, model=DEFAULT)
    for a, b in zip(rig.cameras, direct.cameras, strict=True):
        assert a.matrix_px == pytest.approx(b.matrix_px, abs=1e-4)
