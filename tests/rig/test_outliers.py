"""Blunders are found, also when they hide each other, and clean data lose nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution

from closerange.errors import CloseRangeWarning
from closerange.position.triangulate import triangulate_linear
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.camera_fit import fit_camera
from closerange.rig.models import FREE
from closerange.rig.outliers import FALSE_ALARM, fit_without_blunders, limit, predicted, snoop
from closerange.rig.view import View
from closerange.verification.bound import position_bound, rms_3d_mm
from closerange.verification.scenes import control_grid, observe, random_positions, rig_a, rig_b

BROWN = FREE["brown"]
NOISE_PX = 0.05


def noisy_view(rng, points=27, scene=rig_b) -> View:
    camera = scene().cameras[0]
    xyz = control_grid(points).xyz_mm
    xy = camera.project(xyz)
    return View(camera.name, camera.size_px, xyz, xy + rng.normal(0, NOISE_PX, xy.shape))


def with_blunders(view: View, rows, size_px, rng) -> View:
    angle = rng.uniform(0, 2 * np.pi, len(rows))
    xy = view.xy_px.copy()
    xy[rows] += size_px * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return replace(view, xy_px=xy)


def clean(view: View, trials=None):
    return fit_without_blunders(
        view,
        lambda points, start: fit_camera(points, BROWN, start),
        robust_free=BROWN,
        trials=trials or len(view),
    )


def test_limit_is_the_quantile_of_f():
    for dof, trials in ((1, 20), (4, 27), (38, 54), (2000, 4000)):
        expected = f_distribution.isf(FALSE_ALARM / trials, 2, dof)
        assert limit(dof, trials) == pytest.approx(expected, rel=1e-9)
    assert limit(0, 10) == np.inf


def test_statistic_is_that_of_a_fit_without_the_point():
    """The one-step statistic against a refit; they differ by curvature, which falls with noise."""
    rng = np.random.default_rng(2)
    noisy = noisy_view(rng, points=63)
    exact = rig_b().cameras[0].project(noisy.xyz_mm)
    for scale, tolerance in ((1.0, 2e-2), (0.01, 2e-4)):
        view = replace(noisy, xy_px=exact + scale * (noisy.xy_px - exact))
        statistic = snoop(fit_camera(view, BROWN))
        for row in (0, 17, 62):
            others = np.arange(len(view)) != row
            without = fit_camera(view.select(others), BROWN)
            brute = predicted(without, view.select(~others))[0]
            assert statistic[row] == pytest.approx(brute, rel=tolerance)


def test_clean_data_lose_nothing():
    """By design 1 % of rigs, 0.5 % of views: 1.5 of 300 expected, 6 or more once in 250."""
    rng = np.random.default_rng(4)
    camera = rig_b().cameras[0]
    alarms = 0
    for _ in range(300):
        fit = fit_camera(noisy_view(rng), BROWN, camera)
        alarms += bool((snoop(fit) > limit(fit.dof - 2, 54)).any())
    assert alarms <= 5


@pytest.mark.parametrize(
    ("points", "share", "size_px"),
    [(27, 0.1, 5.0), (63, 0.05, 0.5), (125, 0.05, 5.0), (125, 0.25, 5.0), (63, 0.1, 150.0)],
)
def test_blunders_are_found(points, share, size_px):
    rng = np.random.default_rng(points)
    for scene in (rig_a, rig_b):
        view = noisy_view(rng, points, scene)
        rows = rng.choice(points, max(1, int(share * points)), replace=False)
        result = clean(with_blunders(view, rows, size_px, rng))
        assert set(np.flatnonzero(~result.kept)) == set(rows)
        assert np.sqrt(result.fit.rss_px2 / result.fit.dof) < 1.5 * NOISE_PX
        assert result.plain_px > 1.5 * NOISE_PX


def test_more_than_half_are_no_blunders():
    rng = np.random.default_rng(6)
    view = noisy_view(rng, 63)
    rows = rng.choice(63, 40, replace=False)
    assert clean(with_blunders(view, rows, 20.0, rng)).kept.all()


def test_bar_of_the_plan():
    """5 % outliers of 5 px, rig A, 125 points: calibration error at most 1.15 of the bound.

    Twelve calibrations estimate the ratio to about 7 %: the limit is the bar plus that.
    """
    rng = np.random.default_rng(8)
    scene, control = rig_a(), control_grid(125)
    held_out = random_positions(150, scene.volume_mm, rng).xyz_mm
    bound = rms_3d_mm(position_bound(scene.cameras, BROWN, control.xyz_mm, held_out, NOISE_PX)[1])
    pixels = np.stack([camera.project(held_out) for camera in scene.cameras], axis=1)
    squares = []
    for _ in range(12):
        points = observe(scene.cameras, control, noise_px=NOISE_PX, rng=rng)
        rows = rng.choice(len(points), 12, replace=False)
        angle = rng.uniform(0, 2 * np.pi, 12)
        xy = points.xy_px.copy()
        xy[rows] += 5.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        with pytest.warns(CloseRangeWarning, match="12 outliers"):
            rig = calibrate_rig(replace(points, xy_px=xy), control, sizes(scene), model="brown")
        error = triangulate_linear(rig, pixels, np.ones(pixels.shape[:2], bool)) - held_out
        squares.append(np.mean(np.sum(error**2, axis=1)))
    ratio = np.sqrt(np.mean(squares)) / bound
    assert ratio < 1.15 * 1.07, f"{ratio:.3f} of the bound"  # measured: 1.02 in 40 runs


def test_a_wrong_control_row_is_measured():
    """Item 32: a blunder of 0.75 mm in the control; item 35: a lost minus sign."""
    rng = np.random.default_rng(10)
    scene, control = rig_b(), control_grid(63)
    points = observe(scene.cameras, control, noise_px=NOISE_PX, rng=rng)
    xyz = control.xyz_mm.copy()
    xyz[20] += [0.0, 0.0, 0.75]
    wrong = replace(control, xyz_mm=xyz)
    with pytest.warns(CloseRangeWarning, match="control row is wrong"):
        rig = calibrate_rig(points, wrong, sizes(scene), model="brown")
    entries = rig.report["outliers"]
    assert [entry["point"] for entry in entries] == [control.point[20]] * 2
    assert entries[0]["control_error_mm"] == pytest.approx([0.0, 0.0, 0.75], abs=0.1)
    row = int(np.flatnonzero(control.xyz_mm[:, 0] < -1)[3])
    xyz = control.xyz_mm.copy()
    xyz[row, 0] *= -1
    with pytest.warns(CloseRangeWarning, match="sign of x lost"):
        rig = calibrate_rig(points, replace(control, xyz_mm=xyz), sizes(scene), model="brown")
    assert {entry["point"] for entry in rig.report["outliers"]} == {control.point[row]}
    assert (~rig.residuals.fitted).sum() == 2


def test_exchanged_labels_are_recognised():
    rng = np.random.default_rng(12)
    scene, control = rig_b(), control_grid(63)
    points = observe(scene.cameras, control, noise_px=NOISE_PX, rng=rng)
    xy = points.xy_px.copy()
    xy[[3, 11]] = xy[[11, 3]]
    with pytest.warns(CloseRangeWarning, match="labels exchanged"):
        rig = calibrate_rig(replace(points, xy_px=xy), control, sizes(scene), model="brown")
    assert {entry["point"] for entry in rig.report["outliers"]} == {
        points.point[3],
        points.point[11],
    }


def test_without_rejection_everything_is_fitted():
    rng = np.random.default_rng(14)
    scene, control = rig_b(), control_grid(27)
    points = observe(scene.cameras, control, noise_px=NOISE_PX, rng=rng)
    xy = points.xy_px.copy()
    xy[5] += 3.0
    rig = calibrate_rig(
        replace(points, xy_px=xy), control, sizes(scene), model="brown", reject=False
    )
    assert rig.residuals.fitted.all()
    assert rig.noise_px > 4 * NOISE_PX


def sizes(scene):
    return {camera.name: camera.size_px for camera in scene.cameras}
