"""Rays that meet, against OpenCV and exact points."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from closerange.geometry.intersection import intersect_linear, widest_angle
from closerange.geometry.transform import rotation_from_vector

RNG = np.random.default_rng(2)
K = np.array([[1500.0, 3.0, 640.0], [0, 1480.0, 500.0], [0, 0, 1]])


def matrices(count, shift=(0.0, 0.0, 0.0)):
    """Cameras about 800 mm from the origin, which is moved by `shift`."""
    stack = []
    for i in range(count):
        rotation = rotation_from_vector([0.1 * i, 0.4 * i - 0.4, 0.05])
        translation = np.array([0.0, 0.0, 800.0 + 30 * i]) - rotation @ np.array(shift)
        stack.append(K @ np.column_stack([rotation, translation]))
    return np.array(stack)


def project(stack, xyz):
    homogeneous = np.einsum("cij,mj->mci", stack, np.column_stack([xyz, np.ones(len(xyz))]))
    return homogeneous[..., :2] / homogeneous[..., 2:]


def intersect(stack, px, seen=None, centre=(0, 0, 0)):
    seen = np.ones(px.shape[:2], dtype=bool) if seen is None else seen
    return intersect_linear(stack, px, seen, np.array(centre, dtype=float))


@pytest.mark.parametrize("count", [2, 3, 5])
def test_exact_rays_give_the_exact_point(count):
    xyz = RNG.uniform(-60, 60, (30, 3))
    stack = matrices(count)
    # measured 2e-13 mm
    np.testing.assert_allclose(intersect(stack, project(stack, xyz)), xyz, atol=1e-10)


def test_agrees_with_opencv_where_both_are_exact_to_first_order():
    """OpenCV minimises another algebraic error: with 0.01 px of noise both differ by far less."""
    xyz = RNG.uniform(-60, 60, (30, 3))
    stack = matrices(2)
    px = project(stack, xyz) + 0.01 * RNG.normal(size=(30, 2, 2))
    homogeneous = cv2.triangulatePoints(stack[0], stack[1], px[:, 0].T, px[:, 1].T)
    other = (homogeneous[:3] / homogeneous[3]).T
    ours = intersect(stack, px)
    error, difference = np.abs(ours - xyz).max(), np.abs(ours - other).max()
    assert difference < 0.1 * error


def test_a_far_world_frame_costs_no_digits():
    xyz, shift = RNG.uniform(-60, 60, (30, 3)), np.array([1e6, -2e6, 3e6])
    far = matrices(3, shift)
    px = project(matrices(3), xyz)
    result = intersect(far, px, centre=shift)
    # translations of 4e6 mm carry 5e-10 mm; the rays amplify that a little. Measured 4e-10 mm
    np.testing.assert_allclose(result - shift, xyz, atol=1e-8)


def test_scale_and_sign_of_a_projection_matrix_do_not_matter():
    xyz = RNG.uniform(-60, 60, (5, 3))
    stack = matrices(3)
    px = project(stack, xyz)
    scaled = stack * np.array([1e-3, -7.0, 1e4])[:, None, None]
    np.testing.assert_allclose(intersect(scaled, px), xyz, atol=1e-9)


def test_unseen_views_do_not_count_whatever_they_hold():
    xyz = RNG.uniform(-60, 60, (3, 3))
    stack = matrices(3)
    px = project(stack, xyz)
    seen = np.array([[True, True, False], [True, False, False], [False, False, False]])
    px[0, 2], px[1, 1:], px[2] = 1e9, np.nan, np.nan
    result = intersect(stack, px, seen)
    np.testing.assert_allclose(result[0], xyz[0], atol=1e-10)
    assert np.isnan(result[1:]).all()


def test_parallel_rays_have_no_intersection():
    one = matrices(1)[0]
    beside = one.copy()
    beside[:, 3] += K @ [50.0, 0, 0]  # same attitude, moved sideways
    px = np.array([[[640.0, 500.0], [640.0, 500.0]]])  # the same direction in both
    assert np.isnan(intersect(np.array([one, beside]), px)).all()
    assert np.isnan(intersect(np.array([one, one]), px)).all()  # the same camera twice


def test_no_points():
    assert intersect(matrices(2), np.empty((0, 2, 2))).shape == (0, 3)


def unit(*vectors):
    array = np.array(vectors, dtype=float)
    return array / np.linalg.norm(array, axis=-1, keepdims=True)


def test_widest_angle():
    directions = np.stack([unit([0, 0, 1], [1, 0, 1], [0, 1e-8, 1])])
    everything = np.ones((1, 3), dtype=bool)
    assert widest_angle(directions, everything)[0] == pytest.approx(np.pi / 4)
    near = np.array([[True, False, True]])
    assert widest_angle(directions, near)[0] == pytest.approx(1e-8, rel=1e-6)
    alone = np.array([[True, False, False]])
    assert widest_angle(directions, alone)[0] == 0


def test_rays_against_each_other_make_a_straight_angle():
    directions = np.stack([unit([0, 0, 1], [0, 0, -1])])
    assert widest_angle(directions, np.ones((1, 2), dtype=bool))[0] == pytest.approx(np.pi)


def test_an_unknown_ray_is_left_out():
    directions = np.stack([np.vstack([unit([0, 0, 1], [1, 0, 1]), [[np.nan] * 3]])])
    assert widest_angle(directions, np.ones((1, 3), dtype=bool))[0] == pytest.approx(np.pi / 4)
