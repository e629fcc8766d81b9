"""Measuring: positions, flags and refusals."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, InputError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform, rotation_from_vector
from closerange.position.measure import measure_points
from closerange.rig.distortion import BrownIdeal
from closerange.rig.rig import Trust
from closerange.verification.scenes import (
    SyntheticRig,
    looking_at_origin,
    observe,
    random_positions,
    rig_a,
    rig_b,
)

NONE = int(Flag.none)


def three_cameras(noise_px=0.05):
    pair = rig_b()
    third = looking_at_origin("third", angle_rad=0.05, distance_mm=360.0, focal_px=1300.0)
    return SyntheticRig("three", (*pair.cameras, third), pair.volume_mm, noise_px)


def seen(rig, xyz_mm, noise_px=0.0, seed=0, **control):
    xyz = np.reshape(xyz_mm, (-1, 3))
    points = ControlPoints.of([str(i) for i in range(len(xyz))], xyz, **control)
    return observe(rig.cameras, points, noise_px=noise_px, rng=np.random.default_rng(seed))


def flags_of(positions):
    return [Flag(int(flag)) for flag in positions.flags]


@pytest.mark.parametrize("scene", [rig_a(), rig_b(), three_cameras()], ids=lambda s: s.name)
def test_exact_points_are_measured_exactly(scene):
    rig = scene.true_rig()
    control = random_positions(50, scene.volume_mm, np.random.default_rng(1))
    points = observe(rig.cameras, control, noise_px=0.0, rng=np.random.default_rng(0))
    positions = measure_points(rig, points)
    assert positions.point == control.point
    np.testing.assert_allclose(positions.xyz_mm, control.xyz_mm, atol=1e-9)
    assert (positions.flags == NONE).all()
    assert (positions.cameras == len(rig.cameras)).all()
    assert (positions.residual_px < 1e-9).all()
    assert positions.dof == rig.dof


def test_residual_is_the_root_of_the_mean_square():
    rig = three_cameras().true_rig()
    points = seen(rig, [5.0, 6, 7], noise_px=0.05)
    positions = measure_points(rig, points)
    calculated = [camera.project(positions.xyz_mm)[0] for camera in rig.cameras]
    residual = points.xy_px - calculated
    expected = np.sqrt(np.sum(residual**2) / 6)
    assert positions.residual_px[0] == pytest.approx(expected, rel=1e-9)


def test_rows_belong_together_by_placement_reading_and_point_in_any_order():
    rig = rig_b().true_rig()
    at = {("a", "1"): [0, 0, 0], ("b", "1"): [10, 0, 0], ("a", "2"): [0, 10, 0]}
    rows = [(camera, key) for camera in rig.cameras for key in at]
    points = ImagePoints.of(
        camera=[camera.name for camera, _ in rows],
        placement=[key[0] for _, key in rows],
        reading=[key[1] for _, key in rows],
        point=["01"] * 6,
        xy_px=[camera.project(at[key])[0] for camera, key in rows],
    )
    shuffled = points.select([4, 0, 5, 2, 3, 1])
    positions = measure_points(rig, shuffled)
    assert positions.keys() == [("b", "1", "01"), ("a", "1", "01"), ("a", "2", "01")]
    expected = [[10, 0, 0], [0, 0, 0], [0, 10, 0]]
    np.testing.assert_allclose(positions.xyz_mm, expected, atol=1e-9)


def test_single_view_is_nan_and_flagged():
    rig = rig_b().true_rig()
    points = seen(rig, np.zeros((2, 3)))
    positions = measure_points(rig, points.select([0, 1, 2]))
    assert flags_of(positions) == [Flag.none, Flag.single_view]
    assert np.isnan(positions.xyz_mm[1]).all()
    assert np.isnan(positions.residual_px[1])
    assert positions.cameras.tolist() == [2, 1]


def test_a_point_that_no_camera_found_keeps_its_row_and_flags():
    rig = rig_b().true_rig()
    points = ImagePoints.of(
        camera=["left", "right"],
        point=["1", "1"],
        xy_px=np.full((2, 2), np.nan),
        flags=[int(Flag.not_found), int(Flag.occluded)],
    )
    positions = measure_points(rig, points)
    assert flags_of(positions) == [Flag.not_found | Flag.occluded | Flag.single_view]
    assert positions.cameras.tolist() == [0]


def test_nearly_parallel_rays_are_flagged():
    cameras = tuple(
        looking_at_origin(name, angle_rad=angle, distance_mm=400.0, focal_px=1300.0)
        for name, angle in (("a", 0.0), ("b", np.deg2rad(0.5)), ("c", np.deg2rad(3.0)))
    )
    rig = SyntheticRig("narrow", cameras, rig_b().volume_mm, 0.05).true_rig()
    points = seen(rig, [0.0, 0, 0])
    narrow = measure_points(rig, points.select([0, 1]))
    assert Flag.near_parallel in flags_of(narrow)[0]
    assert np.isfinite(narrow.xyz_mm).all()  # two rays define it, weakly
    assert flags_of(measure_points(rig, points)) == [Flag.none]


def test_a_point_behind_a_camera_is_flagged():
    """Rays that diverge meet behind the cameras."""
    rig = rig_b().true_rig()
    points = ImagePoints.of(
        camera=["left", "right"], point=["1", "1"], xy_px=[[1200, 500], [80, 500]]
    )
    far_apart = points.select([0, 1])
    found = flags_of(measure_points(rig, far_apart))[0]
    swapped = replace(points, xy_px=points.xy_px[::-1])
    other = flags_of(measure_points(rig, swapped))[0]
    # one of the two crossings lies in front, the other diverges
    assert (Flag.behind_camera in found) != (Flag.behind_camera in other)


def test_outside_of_the_volume_by_more_than_its_uncertainty():
    rig = rig_b().true_rig()
    std = np.sqrt(measure_points(rig, seen(rig, [75.0, 0, 0])).cov_mm2[0, 0, 0])
    points = seen(rig, [[75 + 2 * std, 0, 0], [75 + 4 * std, 0, 0], [0, 0, -80], [74, 74, 74]])
    flags = flags_of(measure_points(rig, points))
    assert flags == [Flag.none, Flag.outside_volume, Flag.outside_volume, Flag.none]


def test_a_view_that_is_a_pixel_off_is_flagged():
    rig = three_cameras().true_rig()
    points = seen(rig, [[0.0, 0, 0], [20, 10, 5]], noise_px=0.05)
    xy = points.xy_px.copy()
    xy[2, 1] += 1.0  # point 0 of the right camera, across the epipolar line
    positions = measure_points(rig, replace(points, xy_px=xy))
    assert flags_of(positions) == [Flag.residual, Flag.none]
    assert np.isfinite(positions.xyz_mm).all()


def test_good_points_are_rarely_flagged():
    scene = three_cameras()
    rig = scene.true_rig()
    control = random_positions(3000, 0.5 * scene.volume_mm, np.random.default_rng(2))
    points = observe(rig.cameras, control, noise_px=0.05, rng=np.random.default_rng(3))
    flagged = np.sum(measure_points(rig, points).flags != 0)
    # the chance is 1e-4 at most: 0.3 are expected, 4 or more have a probability of 3e-4
    assert flagged < 4


def test_a_misfit_as_large_as_the_calibration_s_own_is_not_flagged():
    """Stated covariances of 1e-3 px do not make the rig's misfit of 0.05 px a defect."""
    rig = three_cameras().true_rig()
    points = seen(rig, np.zeros((1, 3)), noise_px=0.05)
    sure = replace(points, cov_px2=np.broadcast_to(1e-6 * np.eye(2), (3, 2, 2)))
    positions = measure_points(rig, sure)
    assert flags_of(positions) == [Flag.none]
    assert positions.dof is None


def test_stated_covariances_weigh_the_views():
    rig = three_cameras().true_rig()
    points = seen(rig, np.zeros((1, 3)))
    xy = points.xy_px.copy()
    xy[2] += [0.1, 0.1]
    cov = np.broadcast_to(0.05**2 * np.eye(2), (3, 2, 2)).copy()
    even = measure_points(rig, replace(points, xy_px=xy, cov_px2=cov))
    cov[2] *= 1e8
    uneven = measure_points(rig, replace(points, xy_px=xy, cov_px2=cov))
    assert np.linalg.norm(even.xyz_mm) > 1e-3
    assert np.linalg.norm(uneven.xyz_mm) < 1e-6


def test_points_without_covariance_get_that_of_the_rig():
    rig = rig_b().true_rig()
    points = seen(rig, np.zeros((1, 3)))
    stated = replace(points, cov_px2=np.broadcast_to(rig.noise_px**2 * np.eye(2), (2, 2, 2)))
    one, two = measure_points(rig, points), measure_points(rig, stated)
    np.testing.assert_array_equal(one.cov_mm2, two.cov_mm2)
    assert (one.dof, two.dof) == (rig.dof, None)


def test_an_untrusted_rig_marks_what_is_measured():
    trust = Trust("untrustworthy", np.ones(3), np.ones(3), ("why",))
    rig = replace(rig_b().true_rig(), trust=trust)
    assert flags_of(measure_points(rig, seen(rig, np.zeros((1, 3))))) == [Flag.untrusted]
    fair = replace(rig, trust=replace(trust, verdict="fair"))
    assert flags_of(measure_points(fair, seen(rig, np.zeros((1, 3))))) == [Flag.none]


def test_a_flagged_view_is_left_out_where_two_others_suffice():
    rig = three_cameras().true_rig()
    points = seen(rig, np.zeros((1, 3)))
    xy, flags = points.xy_px.copy(), np.array([0, 0, int(Flag.blurred)])
    xy[2] += 5.0
    positions = measure_points(rig, replace(points, xy_px=xy, flags=flags))
    np.testing.assert_allclose(positions.xyz_mm, 0, atol=1e-9)
    assert positions.cameras.tolist() == [2]
    assert flags_of(positions) == [Flag.none]


def test_a_flagged_view_takes_part_where_it_is_needed_and_its_flag_stays():
    rig = rig_b().true_rig()
    points = replace(seen(rig, np.zeros((1, 3))), flags=np.array([0, int(Flag.saturated)]))
    positions = measure_points(rig, points)
    np.testing.assert_allclose(positions.xyz_mm, 0, atol=1e-9)
    assert flags_of(positions) == [Flag.saturated]


def test_a_camera_that_is_not_in_the_rig():
    rig = rig_b().true_rig()
    points = ImagePoints.of(camera="top", point=["1"], xy_px=[[1, 2]])
    with pytest.raises(InputError, match="camera 'top' is not in the rig; it has left, right"):
        measure_points(rig, points)


def test_images_of_another_size():
    rig = rig_b().true_rig()
    points = replace(seen(rig, np.zeros((1, 3))), size_px={"left": (1280, 960)})
    with pytest.raises(InputError, match="1280x960 px, calibrated with 1280x1024"):
        measure_points(rig, points)


@pytest.mark.parametrize("xy", [[-0.6, 5], [5, -0.6], [1279.6, 5], [5, 1023.6]])
def test_a_point_outside_of_its_image(xy):
    rig = rig_b().true_rig()
    points = ImagePoints.of(camera="left", point=["p7"], xy_px=[xy])
    with pytest.raises(InputError, match=r"camera 'left', point 'p7'.*outside of its 1280x1024"):
        measure_points(rig, points)


def test_the_very_border_is_inside():
    rig = rig_b().true_rig()
    points = ImagePoints.of(camera="left", point=["1", "2"], xy_px=[[-0.5, -0.5], [1279.5, 1023.5]])
    assert len(measure_points(rig, points)) == 2


def test_no_points():
    rig = rig_b().true_rig()
    points = ImagePoints.of(camera="left", point=["1"], xy_px=[[1, 2]]).select([False])
    assert len(measure_points(rig, points)) == 0


def test_a_bumped_camera_is_reported_when_most_rays_miss():
    scene = rig_b()
    points = observe(
        scene.cameras,
        random_positions(20, 0.5 * scene.volume_mm, np.random.default_rng(4)),
        noise_px=0.0,
        rng=np.random.default_rng(0),
    )
    left, right = scene.cameras
    bumped = replace(scene, cameras=(left, right.moved({"ty": 1.0}))).true_rig()
    with pytest.warns(CloseRangeWarning, match=r"rays of 20 of 20 points miss.*camera was moved"):
        positions = measure_points(bumped, points)
    assert (positions.flags & int(Flag.residual)).all()
    assert np.isfinite(positions.xyz_mm).all()


def test_exchanged_cameras_are_reported():
    rig = rig_a().true_rig()
    points = seen(rig, np.random.default_rng(0).uniform(-40, 40, (12, 3)), noise_px=0.05)
    names = {"left": "right", "right": "left"}
    exchanged = replace(points, camera=tuple(names[name] for name in points.camera))
    with pytest.warns(CloseRangeWarning, match="exchanged"):
        measure_points(rig, exchanged)


@pytest.mark.parametrize("seed", range(4))
def test_a_rigid_motion_of_the_world_moves_positions_and_covariances(seed):
    rng = np.random.default_rng(seed)
    rig = three_cameras().true_rig()
    points = seen(rig, rng.uniform(-40, 40, (6, 3)), noise_px=0.05, seed=seed)
    new_from_old = RigidTransform(rotation_from_vector(rng.normal(size=3)), rng.normal(size=3) * 99)
    cameras = tuple(
        replace(c, camera_from_world=c.camera_from_world.after(new_from_old.inverse()))
        for c in rig.cameras
    )
    moved = replace(rig, cameras=cameras, volume_mm=np.array([[-1e3] * 3, [1e3] * 3]))
    one, two = measure_points(rig, points), measure_points(moved, points)
    np.testing.assert_allclose(two.xyz_mm, new_from_old.apply(one.xyz_mm), atol=1e-8)
    turn = new_from_old.rotation
    np.testing.assert_allclose(two.cov_mm2, turn @ one.cov_mm2 @ turn.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(two.residual_px, one.residual_px, atol=1e-9)


def test_the_order_of_cameras_and_rows_does_not_matter():
    rig = three_cameras().true_rig()
    points = seen(rig, np.random.default_rng(1).uniform(-40, 40, (6, 3)), noise_px=0.05)
    backwards = replace(rig, cameras=rig.cameras[::-1])
    other = measure_points(backwards, points.select(np.arange(len(points))[::-1]))
    one = measure_points(rig, points)
    np.testing.assert_allclose(other.xyz_mm[::-1], one.xyz_mm, atol=1e-10)
    np.testing.assert_allclose(other.cov_mm2[::-1], one.cov_mm2, rtol=1e-8, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-3, 25.4, 1e4])
def test_the_unit_of_length_does_not_matter(scale):
    """Micrometres or metres instead of mm: positions and standard deviations scale."""
    rig = three_cameras().true_rig()
    points = seen(rig, np.random.default_rng(1).uniform(-40, 40, (6, 3)), noise_px=0.05)
    cameras = tuple(
        replace(
            c,
            camera_from_world=RigidTransform(
                c.camera_from_world.rotation, scale * c.camera_from_world.translation_mm
            ),
        )
        for c in rig.cameras
    )
    scaled = replace(rig, cameras=cameras, volume_mm=scale * rig.volume_mm)
    one, two = measure_points(rig, points), measure_points(scaled, points)
    np.testing.assert_allclose(two.xyz_mm, scale * one.xyz_mm, rtol=1e-7, atol=1e-8 * scale)
    np.testing.assert_allclose(two.cov_mm2, scale**2 * one.cov_mm2, rtol=1e-5, atol=1e-12)
    assert (two.flags == one.flags).all()


def with_noise(points, seed=3):
    """State a noise for each row that is a part of its covariance, correlated and unequal."""
    root = np.random.default_rng(seed).normal(size=(len(points), 2, 2)) * 0.02
    noise = root @ np.swapaxes(root, 1, 2) + 1e-4 * np.eye(2)
    return replace(points, noise_cov_px2=noise, cov_px2=noise + 0.01**2 * np.eye(2))


def test_noise_is_carried_through_the_derivatives_of_the_position():
    rig = three_cameras().true_rig()
    points = with_noise(seen(rig, [[5.0, 6, 7], [-20, 3, 9]], noise_px=0.02))
    positions = measure_points(rig, points)
    expected = np.zeros((2, 3, 3))
    step = 1e-3
    for row in range(len(points)):
        shift = np.zeros((2, *points.xy_px.shape))
        shift[(0, 1), row, (0, 1)] = step
        ahead, back = (
            np.array([measure_points(rig, replace(points, xy_px=xy)).xyz_mm for xy in moved])
            for moved in (points.xy_px + shift, points.xy_px - shift)
        )
        slopes = (ahead - back) / (2 * step)  # (2, points, 3)
        expected += np.einsum("imk,ij,jml->mkl", slopes, points.noise_cov_px2[row], slopes)
    np.testing.assert_allclose(positions.noise_cov_mm2, expected, rtol=1e-3, atol=1e-7)
    assert np.linalg.eigvalsh(positions.cov_mm2 - positions.noise_cov_mm2).min() > 0


def test_noise_is_unknown_unless_every_view_that_is_used_states_it():
    rig = three_cameras().true_rig()
    points = with_noise(seen(rig, [[5.0, 6, 7], [-20, 3, 9], [0, 0, 0]]))
    noise = points.noise_cov_px2.copy()
    noise[0] = noise[1] = np.nan
    flags = points.flags.copy()
    flags[1] = int(Flag.blurred)  # left out: two other views see the second point
    positions = measure_points(rig, replace(points, noise_cov_px2=noise, flags=flags))
    known = np.isfinite(positions.noise_cov_mm2).all(axis=(1, 2))
    assert known.tolist() == [False, True, True]
    assert np.isfinite(positions.cov_mm2).all()


def test_discs_are_measured_at_their_centres():
    """A large tilted disc: its image centre lies 0.18 mm off in space, its position does not."""
    rig = rig_b().true_rig()
    centre, normal, radius = np.array([10.0, -5, 8]), np.array([0.5, 0.2, 1.0]), 10.0
    normal /= np.linalg.norm(normal)
    u = np.cross(normal, [1.0, 0, 0])
    u /= np.linalg.norm(u)
    v = np.cross(normal, u)
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)[:, None]
    outline = centre + radius * (np.cos(turn) * u + np.sin(turn) * v)
    xy, ellipses = [], []
    for camera in rig.cameras:
        edge = camera.project(outline)
        middle = edge.mean(axis=0)
        (x, y), (width, height), degrees = cv2.fitEllipse(
            (edge - middle).reshape(-1, 1, 2).astype(np.float32)
        )
        assert width <= height
        xy.append(middle + np.array([x, y]))
        ellipses.append([height / 2, width / 2, np.deg2rad(degrees + 90)])
    points = ImagePoints.of(
        camera=["left", "right"],
        point=["1", "1"],
        xy_px=xy,
        ellipse=ellipses,
        disc_diameter_mm=2 * radius,
    )
    biased = measure_points(rig, replace(points, disc_diameter_mm=np.full(2, np.nan)))
    error = np.linalg.norm(measure_points(rig, points).xyz_mm - centre)
    assert np.linalg.norm(biased.xyz_mm - centre) > 0.1
    assert error < 0.002  # measured 7e-5 mm


def beyond_the_fold(xy_third, xyz_mm):
    """Three cameras, of which the third's lens folds back at 348 px, within its image.

    The third looks from nearby, so that `xyz_mm` lies beyond its fold.
    """
    lens = BrownIdeal(k1=-0.6)
    third = looking_at_origin(
        "third", angle_rad=0.0, distance_mm=225.0, focal_px=700.0, distortion=lens
    )
    pair = rig_b()
    volume = np.array([[-400.0] * 3, [400.0] * 3])
    rig = SyntheticRig("fold", (*pair.cameras, third), volume, 0.05).true_rig()
    points = seen(pair, xyz_mm)
    return rig, points + ImagePoints.of(camera="third", point=["0"], xy_px=[xy_third])


def test_a_view_beyond_the_lens_is_left_out_and_said():
    """The other two measure the point; the row says that a view was lost."""
    xyz = [140.0, 100.0, 60.0]
    rig, points = beyond_the_fold([1270.0, 1000.0], xyz)
    assert np.isnan(rig.cameras[2].undistort([[1270.0, 1000.0]])).all()
    positions = measure_points(rig, points)
    np.testing.assert_allclose(positions.xyz_mm, [xyz], atol=1e-9)
    assert positions.cameras.tolist() == [2]
    assert positions.residual_px[0] < 1e-9
    assert flags_of(positions) == [Flag.beyond_lens]


def test_with_two_cameras_a_view_beyond_the_lens_is_the_reason_why_nothing_is_measured():
    rig, points = beyond_the_fold([1270.0, 1000.0], [140.0, 100.0, 60.0])
    positions = measure_points(rig, points.select([1, 2]))
    assert flags_of(positions) == [Flag.single_view | Flag.beyond_lens]
    assert np.isnan(positions.xyz_mm).all()
    assert positions.cameras.tolist() == [1]


def test_a_flagged_view_beyond_the_lens_is_not_missed():
    rig, points = beyond_the_fold([1270.0, 1000.0], [140.0, 100.0, 60.0])
    flagged = replace(points, flags=np.array([0, 0, int(Flag.blurred)]))
    assert flags_of(measure_points(rig, flagged)) == [Flag.none]


def test_a_used_view_without_a_residual_is_never_silent():
    """The third sees the point where its lens has an answer; the point lies where it has none."""
    rig, points = beyond_the_fold([639.5 + 240.0, 511.5 + 200.0], [140.0, 100.0, 60.0])
    assert np.isfinite(rig.cameras[2].undistort(points.xy_px[2:])).all()
    positions = measure_points(rig, points)
    assert np.isnan(positions.residual_px).all()
    assert positions.cameras.tolist() == [3]
    assert Flag.not_converged in flags_of(positions)[0]


@pytest.mark.parametrize(
    "unknown",
    [{"noise_px": np.nan}, {"noise_px": 0.0}, {"parameters": ("left.fx",), "cov": np.nan}],
    ids=["no noise known", "noise of zero", "no covariance"],
)
def test_a_rig_of_unknown_uncertainty_measures_positions_that_are_marked(unknown):
    scene = rig_b()
    changes = {"parameter_cov": [[unknown.pop("cov")]]} if "cov" in unknown else {}
    rig = replace(scene.true_rig(), **unknown, **changes)
    positions = measure_points(rig, seen(rig, [[5.0, 6, 7], [-5, 0, 9]]))
    np.testing.assert_allclose(positions.xyz_mm, [[5, 6, 7], [-5, 0, 9]], atol=1e-9)
    assert np.isnan(positions.cov_mm2).all()
    assert flags_of(positions) == [Flag.untrusted] * 2


def test_tau_is_added_to_what_is_stated_and_to_nothing_else():
    rig = three_cameras().true_rig()
    points = seen(rig, np.zeros((1, 3)))
    variance = 0.01**2
    some = np.full((3, 2, 2), np.nan)
    some[0] = variance * np.eye(2)
    tau = np.sqrt(rig.noise_px**2 - variance)  # the sum is that of the two that state nothing
    one = measure_points(replace(rig, tau_px=tau), replace(points, cov_px2=some))
    two = measure_points(rig, points)
    np.testing.assert_allclose(one.cov_mm2, two.cov_mm2, rtol=1e-12)
    assert one.dof == rig.dof


def test_tau_does_not_count_twice_when_rays_are_compared():
    """With all of the misfit in tau, a good point is flagged as rarely as without covariances."""
    rig = replace(three_cameras().true_rig(), tau_px=0.05)
    points = seen(rig, np.zeros((1, 3)))
    xy, cov = points.xy_px.copy(), np.broadcast_to(1e-10 * np.eye(2), (3, 2, 2))
    # the rest of 6 - 3 = 3 squares has its 1e-4 point at 21.1: 0.23 px across the epipolar plane
    for shift, flag in ((0.2, Flag.none), (0.35, Flag.residual)):
        xy[2, 1] = points.xy_px[2, 1] + shift
        positions = measure_points(rig, replace(points, xy_px=xy, cov_px2=cov))
        assert flags_of(positions) == [flag], shift
