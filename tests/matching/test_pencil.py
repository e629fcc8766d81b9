"""The pencil of epipolar planes: one number for correspondence, one for depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import InputError
from closerange.geometry.transform import RigidTransform
from closerange.matching.pencil import Pencil
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from closerange.verification.scenes import looking_at_origin, rig_a, rig_b, strong_lens_rig

RIGS = {"A": rig_a, "B": rig_b, "strong lens": strong_lens_rig}


def points(rig, count=200):
    rng = np.random.default_rng(0)
    low, high = rig.volume_mm
    return low + (high - low) * rng.random((count, 3))


@pytest.mark.parametrize("name", RIGS)
def test_projections_of_one_point_have_one_theta_and_give_it_back(name):
    rig = RIGS[name]()
    first, second = rig.cameras[:2]
    pencil = Pencil.of(first, second)
    xyz = points(rig)
    theta_1, slope_1 = pencil.coordinates(first, first.project(xyz))
    theta_2, slope_2 = pencil.coordinates(second, second.project(xyz))
    seen = np.isfinite(theta_1) & np.isfinite(theta_2)
    assert seen.mean() > 0.9
    np.testing.assert_allclose(theta_1[seen], theta_2[seen], atol=1e-9)
    back = pencil.point(theta_1[seen], slope_1[seen], slope_2[seen])
    np.testing.assert_allclose(back, xyz[seen], atol=1e-5)


def test_reversed_changes_the_signs_and_gives_the_same_points():
    rig = rig_a()
    first, second = rig.cameras[:2]
    pencil, other = Pencil.of(first, second), Pencil.of(first, second).reversed()
    assert np.linalg.det(other.axes) == pytest.approx(1.0)
    xy = first.project(points(rig))
    theta, slope = pencil.coordinates(first, xy)
    theta_r, slope_r = other.coordinates(first, xy)
    np.testing.assert_allclose(theta_r, -theta, atol=1e-12)
    np.testing.assert_allclose(slope_r, -slope, atol=1e-12)
    theta_2, slope_2 = other.coordinates(second, second.project(points(rig)))
    np.testing.assert_allclose(other.point(theta_2, slope_2, slope_r), points(rig), atol=1e-5)


def test_an_epipole_inside_the_image_does_no_harm():
    """One camera looks past the other, from behind it."""
    matrix = np.array([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]])
    near = Camera("near", (640, 480), matrix, RigidTransform(np.eye(3), np.zeros(3)))
    behind = replace(
        near, name="behind", camera_from_world=RigidTransform(np.eye(3), np.array([5.0, 3, 200]))
    )
    epipole = behind.project(near.centre_mm[None])[0]
    assert ((epipole > 0) & (epipole < [640, 480])).all()
    rng = np.random.default_rng(1)
    xyz = np.column_stack([rng.uniform(-150, 150, (100, 2)), rng.uniform(500, 900, 100)])
    pencil = Pencil.of(near, behind)
    assert pencil.baseline_mm == pytest.approx(np.linalg.norm([5, 3, 200]))
    theta_1, slope_1 = pencil.coordinates(near, near.project(xyz))
    theta_2, slope_2 = pencil.coordinates(behind, behind.project(xyz))
    turn = np.angle(np.exp(1j * (theta_1 - theta_2)))
    np.testing.assert_allclose(turn, 0.0, atol=1e-9)
    np.testing.assert_allclose(pencil.point(theta_1, slope_1, slope_2), xyz, atol=1e-6)


def test_rays_that_part_give_no_point():
    pencil = Pencil.of(*rig_a().cameras[:2])
    point = pencil.point(np.zeros(2), np.array([0.1, 0.3]), np.array([0.2, 0.3]))
    assert np.isnan(point).all()


def test_cameras_at_one_place_are_refused():
    one = looking_at_origin("one", angle_rad=0.1, distance_mm=500.0, focal_px=900.0)
    other = replace(one, name="other", distortion=BrownIdeal(k1=0.1))
    with pytest.raises(InputError, match="'one' and 'other' are 0 mm apart"):
        Pencil.of(one, other)
