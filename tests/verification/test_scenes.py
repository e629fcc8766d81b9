"""Synthetic scenes: geometry, names, observation."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.position.measure import measure_points
from closerange.verification.scenes import (
    GRIDS,
    control_grid,
    looking_at_origin,
    observe,
    random_positions,
    rig_a,
    rig_b,
    strong_lens_rig,
)


@pytest.mark.parametrize(
    ("rig", "distance_mm", "distortion_px"),
    [(rig_a(), 1500, (0.2, 0.6)), (rig_b(), 350, (9, 13)), (strong_lens_rig(), 225, (85, 91))],
)
def test_rigs_are_those_of_the_calibration_report(rig, distance_mm, distortion_px):
    left, right = rig.cameras
    assert np.allclose([np.linalg.norm(c.centre_mm) for c in rig.cameras], distance_mm)
    cosine = left.centre_mm @ right.centre_mm / distance_mm**2
    assert np.degrees(np.arccos(cosine)) == pytest.approx(40)
    corners = control_grid((2, 2, 2)).xyz_mm
    for camera in rig.cameras:
        seen = camera.project(corners)
        assert (seen > 0).all()
        assert (seen < np.array(camera.size_px) - 1).all()
    largest = np.linalg.norm(left.project(corners) - left.undistort(left.project(corners)), axis=1)
    assert distortion_px[0] < largest.max() < distortion_px[1]


def test_camera_sees_y_upwards_and_x_to_the_right():
    camera = looking_at_origin("c", angle_rad=0.0, distance_mm=100, focal_px=1000)
    middle, right, up = camera.project([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert np.allclose(middle, [639.5, 511.5])
    assert np.allclose(right - middle, [10, 0])
    assert np.allclose(up - middle, [0, -10])


@pytest.mark.parametrize("count", GRIDS)
def test_grids_have_their_count_and_fill_the_box(count):
    control = control_grid(count, (10.0, 20.0, 30.0))
    assert len(control) == count == len(set(control.point))
    assert np.allclose(np.ptp(control.xyz_mm, axis=0), [10, 20, 30])
    assert np.allclose(control.xyz_mm.mean(axis=0), 0)


def test_unknown_count_names_the_known_ones():
    with pytest.raises(InputError, match=r"28 points[^$]*18, 27"):
        control_grid(28)


def test_single_plane_lies_in_the_middle():
    assert not control_grid((3, 3, 1)).xyz_mm[:, 2].any()


def test_noise_has_the_stated_size_and_a_seed_repeats_it():
    rig = rig_b()
    control = control_grid(343)
    first, again = (
        observe(rig.cameras, control, noise_px=0.05, rng=np.random.default_rng(1), readings=3)
        for _ in range(2)
    )
    assert np.array_equal(first.xy_px, again.xy_px)
    assert len(first) == 2 * 3 * 343
    exact = np.concatenate([np.tile(c.project(control.xyz_mm), (3, 1)) for c in rig.cameras])
    # 4116 coordinates: the standard error of their standard deviation is 1.1 %
    assert (first.xy_px - exact).std() == pytest.approx(0.05, rel=0.04)


def test_points_outside_of_an_image_are_flagged():
    rig = rig_b()
    control = random_positions(1, [[300, 0, 0], [301, 1, 1]], np.random.default_rng(0))
    seen = observe(rig.cameras, control, noise_px=0.0, rng=np.random.default_rng(0))
    assert np.isnan(seen.xy_px).any()
    assert (seen.flags[~seen.found] == Flag.not_found).all()


def test_true_rig_measures_noise_free_points_exactly():
    rig = strong_lens_rig()
    truth = random_positions(50, rig.volume_mm, np.random.default_rng(2))
    seen = observe(rig.cameras, truth, noise_px=0.0, rng=np.random.default_rng(0))
    positions = measure_points(rig.true_rig(), seen)
    assert positions.point == truth.point
    assert np.abs(positions.xyz_mm - truth.xyz_mm).max() < 1e-9
