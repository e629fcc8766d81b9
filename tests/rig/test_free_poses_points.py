"""Free poses: blunders, check points, weights, disc centres and the volume, as in known poses."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
from scipy.stats import chi2

from closerange.errors import CloseRangeWarning, GeometryError, InputError
from closerange.features.control import ControlPoints
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.rig.free_poses import calibrate_free_poses
from closerange.rig.models import FREE
from closerange.verification.scenes import control_grid, observe, rig_b

NOISE_PX = 0.05
CAMERAS = rig_b().cameras
SIZES = {camera.name: camera.size_px for camera in CAMERAS}
PLATE = control_grid((5, 5, 1), (80.0, 80.0, 0.0))
TILTS = [(0, 0), (0.5, 0.1), (-0.5, 0.2), (0.1, 0.6), (0.2, -0.6), (-0.4, -0.4), (0.6, 0.5)]


@cache
def poses():
    """World from target; the first is the world, so that the true cameras are the scene's."""
    rng = np.random.default_rng(4)
    return [
        RigidTransform(
            rotation_from_vector([rx, ry, rng.uniform(-0.5, 0.5) if i else 0.0]),
            rng.uniform(-25, 25, 3) * (i > 0),
        )
        for i, (rx, ry) in enumerate(TILTS)
    ]


def seen(target=PLATE, seed=1, noise_px=NOISE_PX):
    rng, total = np.random.default_rng(seed), None
    for number, pose in enumerate(poses()):
        world = ControlPoints.of(target.point, pose.apply(target.xyz_mm), placement=f"p{number}")
        points = observe(CAMERAS, world, noise_px=noise_px, rng=rng)
        total = points if total is None else total + points
    assert total.found.all()
    return total


def errors_of(rig):
    """Truth minus estimate of all parameters; turns as the small angles of the covariance."""
    found = []
    for camera, truth in zip(rig.cameras, CAMERAS, strict=True):
        turn = truth.camera_from_world.rotation @ camera.camera_from_world.rotation.T
        small = dict(zip(("rx", "ry", "rz"), np.ravel(cv2.Rodrigues(turn)[0]), strict=True))
        found += [
            small.get(name, truth.parameter(name) - camera.parameter(name))
            for name in FREE[rig.model]
        ]
    return np.array(found)


def scaled_square(rig):
    scaled = np.linalg.solve(np.linalg.cholesky(rig.parameter_cov), errors_of(rig))
    return float(scaled @ scaled)


def outliers_of(rig):
    return np.flatnonzero((rig.residuals.flags & int(Flag.outlier)) != 0).tolist()


def test_clean_points_lose_none():
    rig = calibrate_free_poses(seen(), PLATE, SIZES)
    assert rig.residuals.fitted.all()
    assert rig.report["outliers"] == []
    # 700 numbers, 64 parameters: s is known to 3 %
    assert rig.noise_px == pytest.approx(NOISE_PX, rel=0.12)


def test_a_blunder_is_left_out_flagged_and_does_no_harm():
    clean = seen()
    xy = clean.xy_px.copy()
    xy[7] += [6.0, 0.0]
    with pytest.warns(CloseRangeWarning, match="1 outliers are left out of the fit"):
        rig = calibrate_free_poses(replace(clean, xy_px=xy), PLATE, SIZES)
    assert outliers_of(rig) == [7]
    assert np.flatnonzero(~rig.residuals.fitted).tolist() == [7]
    assert rig.residuals.residual_px[7] == pytest.approx([6.0, 0.0], abs=0.5)
    (entry,) = rig.report["outliers"]
    assert (entry["camera"], entry["placement"], entry["point"]) == (
        *("left", "p0"),
        clean.point[7],
    )
    without = calibrate_free_poses(clean.select(np.arange(len(clean)) != 7), PLATE, SIZES)
    assert rig.noise_px == pytest.approx(without.noise_px, rel=1e-6)
    np.testing.assert_allclose(rig.parameter_cov, without.parameter_cov, rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize(("share", "size_px"), [(0.03, 3.0), (0.1, 40.0), (0.2, 8.0)])
def test_many_blunders_are_found(share, size_px):
    clean, rng = seen(), np.random.default_rng(5)
    bad = np.sort(rng.choice(len(clean), int(share * len(clean)), replace=False))
    angle = rng.uniform(0, 2 * np.pi, len(bad))
    xy = clean.xy_px.copy()
    xy[bad] += size_px * np.column_stack([np.cos(angle), np.sin(angle)])
    with pytest.warns(CloseRangeWarning, match="outliers"):
        rig = calibrate_free_poses(replace(clean, xy_px=xy), PLATE, SIZES)
    assert outliers_of(rig) == bad.tolist()
    assert rig.noise_px == pytest.approx(NOISE_PX, rel=0.15)


def test_exchanged_labels_are_named():
    clean = seen()
    names = list(clean.point)
    names[0], names[18] = names[18], names[0]
    with pytest.warns(CloseRangeWarning, match="labels exchanged"):
        rig = calibrate_free_poses(replace(clean, point=tuple(names)), PLATE, SIZES)
    assert outliers_of(rig) == [0, 18]


def test_an_image_named_in_another_order_is_refused_by_name():
    """A half turn is a possible pose for one camera, but not the one that the other sees."""
    clean = seen()
    names = list(clean.point)
    rows = [i for i, key in enumerate(clean.keys()) if key[:2] == ("left", "p3")]
    for row, name in zip(rows, [names[i] for i in rows][::-1], strict=True):
        names[row] = name
    with pytest.raises(GeometryError, match=r"placement 'p3': 2\d of 25 points contradict"):
        calibrate_free_poses(replace(clean, point=tuple(names)), PLATE, SIZES)


def test_check_points_are_not_fitted_but_compared():
    check = np.arange(25) % 6 == 0
    target = replace(PLATE, check=check)
    points = seen()
    is_check = np.array([check[PLATE.point.index(name)] for name in points.point])
    rig = calibrate_free_poses(points, target, SIZES)
    np.testing.assert_array_equal(rig.residuals.fitted, ~is_check)
    assert not rig.residuals.flags.any()
    assert rig.report["left_out"] == {"check point": int(is_check.sum())}
    left = rig.residuals.residual_px[is_check]
    # their own noise and what the calibration foretells of them
    assert NOISE_PX * 0.8 < np.sqrt(np.mean(left**2)) < NOISE_PX * 1.4
    alone = calibrate_free_poses(points.select(~is_check), PLATE, SIZES)
    np.testing.assert_allclose(rig.parameter_cov, alone.parameter_cov, rtol=1e-6)


def test_the_volume_is_the_stated_one_or_encloses_what_was_fitted():
    stated = [[-10.0, -20, -30], [10, 20, 30]]
    rig = calibrate_free_poses(seen(), PLATE, SIZES, volume_mm=stated)
    np.testing.assert_array_equal(rig.volume_mm, stated)
    assert rig.report["volume"] == "stated"
    with pytest.raises(InputError, match="not below its upper corner"):
        calibrate_free_poses(seen(), PLATE, SIZES, volume_mm=stated[::-1])


def test_points_outside_of_the_image_are_refused():
    with pytest.raises(InputError, match="lie outside of the image"):
        calibrate_free_poses(seen(), PLATE, dict.fromkeys(SIZES, (300, 200)))


@pytest.mark.filterwarnings("ignore::closerange.errors.CloseRangeWarning")  # half are "outliers"
def test_covariances_weigh():
    """Every other point is ten times noisier: stated, it costs little and the covariance holds."""
    squares, weighted, plain = [], [], []
    for seed in range(5):
        points = seen(seed=seed)
        noisy = np.arange(len(points)) % 2 == 0
        std = np.where(noisy, 0.5, NOISE_PX)
        extra = np.random.default_rng(100 + seed).standard_normal((len(points), 2))
        xy = points.xy_px + extra * np.sqrt(std**2 - NOISE_PX**2)[:, None]
        unknown = replace(points, xy_px=xy)
        stated = replace(unknown, cov_px2=std[:, None, None] ** 2 * np.eye(2))
        rig = calibrate_free_poses(stated, PLATE, SIZES)
        squares.append(scaled_square(rig))
        weighted.append(errors_of(rig))
        plain.append(errors_of(calibrate_free_poses(unknown, PLATE, SIZES)))
    gain = np.median(np.std(plain, axis=0) / np.std(weighted, axis=0))
    assert gain > 3.0, gain
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 28 * 5)
    assert 0.8 * low < np.sum(squares) < 1.05 * high, np.mean(squares)  # tau^2 >= 0: conservative
    assert rig.report["weights"]["points_with_covariance"] == len(points)


def test_gaps_in_the_covariances_cost_a_warning_not_the_weights():
    points = seen()
    cov = np.tile(NOISE_PX**2 * np.eye(2), (len(points), 1, 1))
    full = calibrate_free_poses(replace(points, cov_px2=cov), PLATE, SIZES)
    cov[3] = np.nan
    with pytest.warns(CloseRangeWarning, match=f"1 of {len(points)} points have no covariance"):
        gap = calibrate_free_poses(replace(points, cov_px2=cov), PLATE, SIZES)
    np.testing.assert_allclose(gap.parameter_cov, full.parameter_cov, rtol=1e-6)


def test_errors_of_the_target_are_in_the_covariance():
    """A print off by 30 um, the same in all placements: the stated covariance holds."""
    squares, ignoring, runs, std_mm = [], [], 8, 0.03
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        printed = replace(PLATE, xyz_mm=PLATE.xyz_mm + rng.normal(0, std_mm, (25, 3)))
        points = seen(printed, seed=50 + seed)
        stated = replace(PLATE, std_mm=np.full(25, std_mm))
        squares.append(scaled_square(calibrate_free_poses(points, stated, SIZES)))
        ignoring.append(scaled_square(calibrate_free_poses(points, PLATE, SIZES)))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 28 * runs)
    # on the safe side: the target's errors count as image noise too
    assert 0.2 * low < np.sum(squares) < high, f"mean {np.mean(squares):.1f}, 28 if exact"
    assert np.sum(ignoring) > 1.5 * high, f"mean {np.mean(ignoring):.1f}"


def test_disc_centres_are_corrected():
    """Discs of 16 mm: their images' centres lie up to 0.1 px from the images of their centres."""
    xy, ellipses = [], []
    rng, exact = np.random.default_rng(8), seen(noise_px=0.0)
    turn = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    rim = 8.0 * np.column_stack([np.cos(turn), np.sin(turn), np.zeros(90)])
    for camera, placement, _, point in list(exact.keys()):
        pose = poses()[int(placement[1:])]
        middle = PLATE.xyz_mm[PLATE.point.index(point)]
        edge = next(c for c in CAMERAS if c.name == camera).project(pose.apply(middle + rim))
        about = edge.mean(axis=0)
        (x, y), (minor, major), degrees = cv2.fitEllipseDirect(
            (edge - about).reshape(-1, 1, 2).astype(np.float32)
        )
        xy.append(about + rng.normal((x, y), 0.003))
        ellipses.append((major / 2, minor / 2, np.deg2rad(degrees + 90)))
    seen_discs = replace(exact, xy_px=np.array(xy), ellipse=np.array(ellipses))
    discs = replace(seen_discs, disc_diameter_mm=np.full(len(exact), 16.0))
    corrected = calibrate_free_poses(discs, PLATE, SIZES)
    biased = calibrate_free_poses(seen_discs, PLATE, SIZES)
    assert corrected.report["disc_bias"]["corrected_points"] == len(exact)
    assert corrected.report["disc_bias"]["largest_px"] == pytest.approx(
        np.linalg.norm(np.array(xy) - exact.xy_px, axis=1).max(), rel=0.15
    )
    centres = [
        np.abs([c.centre_mm - t.centre_mm for c, t in zip(rig.cameras, CAMERAS, strict=True)]).max()
        for rig in (corrected, biased)
    ]
    assert centres[0] < 0.1 * centres[1], centres
    assert corrected.noise_px < 0.3 * biased.noise_px, (corrected.noise_px, biased.noise_px)


def test_points_of_a_poor_image_still_help_where_another_camera_sees_the_placement():
    points = seen()
    few = np.array([key[:2] != ("left", "p6") or i % 6 == 0 for i, key in enumerate(points.keys())])
    rig = calibrate_free_poses(points.select(few), PLATE, SIZES)
    names = rig.residuals.camera, rig.residuals.placement
    left = [key == ("left", "p6") for key in zip(*names, strict=True)]
    assert 0 < np.count_nonzero(left) < 6
    assert rig.residuals.fitted[left].all()
