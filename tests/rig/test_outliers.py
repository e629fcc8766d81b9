"""Blunders are found, also when they hide each other, and clean data lose nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution

from closerange.errors import CloseRangeWarning, GeometryError
from closerange.position.triangulate import triangulate_linear
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.camera_fit import fit_camera
from closerange.rig.models import FREE
from closerange.rig.outliers import (
    FALSE_ALARM,
    consensus,
    fit_without_blunders,
    limit,
    predicted,
    snoop,
)
from closerange.rig.view import View
from closerange.verification.bound import position_bound, rms_3d_mm
from closerange.verification.scenes import (
    control_grid,
    looking_at_origin,
    observe,
    random_positions,
    rig_a,
    rig_b,
)
from closerange.verification.trust import judge_rig

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


def three_cameras():
    """Rig A with a third camera that looks along Z: errors of Z are hidden from it."""
    pair = rig_a()
    middle = looking_at_origin("middle", angle_rad=0.0, distance_mm=1500.0, focal_px=4800.0)
    return replace(pair, cameras=(*pair.cameras, middle))


@pytest.mark.parametrize("scene", [rig_a, rig_b, three_cameras])
@pytest.mark.parametrize("points", [27, 63])
def test_one_wrong_control_row_of_any_size(scene, points):
    """From 0.5 mm to 3 m in any direction: that row is left out by all cameras, and no other.

    Behind a camera that sees it, it is refused by name.
    """
    rig, control = scene(), control_grid(points)
    for number, size_mm in enumerate(0.5 * 6000 ** np.linspace(0, 1, 6)):
        rng = np.random.default_rng([points, number])
        seen = observe(rig.cameras, control, noise_px=NOISE_PX, rng=rng)
        row, axis = rng.integers(points), rng.integers(3)
        xyz = control.xyz_mm.copy()
        xyz[row, axis] += size_mm * rng.choice([-1, 1])
        wrong = replace(control, xyz_mm=xyz)
        if any(camera.depth_mm(xyz[row]).item() <= 0 for camera in rig.cameras):
            with pytest.raises(GeometryError, match=f"{control.point[row]}.* behind camera"):
                calibrate_rig(seen, wrong, sizes(rig), model="brown")
            continue
        with pytest.warns(CloseRangeWarning, match="outliers are left out"):
            result = calibrate_rig(seen, wrong, sizes(rig), model="brown")
        out = np.flatnonzero(~result.residuals.fitted)
        assert [result.residuals.point[i] for i in out] == [control.point[row]] * len(rig.cameras)
        assert result.noise_px == pytest.approx(NOISE_PX, rel=0.35)  # 23 to 209 dof
        assert judge_rig(result).verdict == "good"


def test_a_far_row_does_not_stretch_the_volume():
    scene, control = rig_b(), control_grid(27)
    seen = observe(scene.cameras, control, noise_px=NOISE_PX, rng=np.random.default_rng(16))
    xyz = control.xyz_mm.copy()
    xyz[5, 0] *= 10  # a lost decimal point
    with pytest.warns(CloseRangeWarning, match="2 outliers"):
        rig = calibrate_rig(seen, replace(control, xyz_mm=xyz), sizes(scene), model="brown")
    np.testing.assert_array_equal(rig.volume_mm, scene.volume_mm)


@pytest.mark.parametrize("scene", [rig_a, rig_b])
def test_one_wrong_image_point_of_any_size(scene):
    """From 0.5 to 300 px: that point is left out, and its row stays in the other camera."""
    for number, size_px in enumerate(0.5 * 600 ** np.linspace(0, 1, 5)):
        rng = np.random.default_rng(number)
        rig, control = scene(), control_grid(27)
        seen = observe(rig.cameras, control, noise_px=NOISE_PX, rng=rng)
        row = int(rng.integers(len(seen)))
        xy = seen.xy_px.copy()
        towards_middle = np.array([640.0, 512.0]) - xy[row]  # so that it stays in the image
        xy[row] += size_px * towards_middle / np.linalg.norm(towards_middle)
        with pytest.warns(CloseRangeWarning, match="1 outliers"):
            result = calibrate_rig(replace(seen, xy_px=xy), control, sizes(rig), model="brown")
        assert np.flatnonzero(~result.residuals.fitted).tolist() == [row]


def test_consensus_has_no_part_for_far_points():
    """A third of the points are anywhere, some behind the camera."""
    rng = np.random.default_rng(18)
    view = noisy_view(rng, 63)
    rows = rng.choice(63, 21, replace=False)
    xyz = view.xyz_mm.copy()
    xyz[rows] = rng.normal(0, 1000, (21, 3))
    agreeing = consensus(replace(view, xyz_mm=xyz))
    assert not agreeing[rows].any()
    assert np.count_nonzero(agreeing) > 0.8 * 42


@pytest.mark.parametrize("scene", [rig_a, rig_b])
@pytest.mark.parametrize("points", [27, 63])
def test_a_mirrored_world_is_not_sorted_into_a_camera(scene, points):
    view = noisy_view(np.random.default_rng(20), points, scene)
    with pytest.raises(GeometryError, match=r"mirrored camera|cannot tell"):
        clean(replace(view, xyz_mm=view.xyz_mm * [1, 1, -1]))


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
