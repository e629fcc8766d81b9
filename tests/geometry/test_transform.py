"""Rigid transforms against OpenCV and SciPy."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from closerange.geometry.transform import (
    RigidTransform,
    cross_matrix,
    rotation_from_vector,
)

RNG = np.random.default_rng(5)


def random_transform():
    return RigidTransform(Rotation.random(random_state=RNG).as_matrix(), RNG.normal(size=3) * 100)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 9e-5, 1.1e-4, 0.3, np.pi - 1e-9, np.pi, 7.0])
def test_rodrigues_is_opencv_s(angle):
    vector = angle * np.array([1.0, -2.0, 2.0]) / 3
    rotation = rotation_from_vector(vector)
    # measured 7e-16
    np.testing.assert_allclose(rotation, cv2.Rodrigues(vector)[0], atol=1e-14)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_inverse_and_chain_cancel():
    a_from_b, b_from_c = random_transform(), random_transform()
    points = RNG.normal(size=(7, 3)) * 50
    chained = a_from_b.after(b_from_c).apply(points)
    np.testing.assert_allclose(chained, a_from_b.apply(b_from_c.apply(points)), atol=1e-10)
    np.testing.assert_allclose(a_from_b.inverse().apply(a_from_b.apply(points)), points, atol=1e-10)


def test_apply_keeps_the_leading_shape():
    transform = random_transform()
    points = RNG.normal(size=(2, 4, 3))
    moved = transform.apply(points)
    assert moved.shape == (2, 4, 3)
    np.testing.assert_allclose(
        moved[1, 2], transform.rotation @ points[1, 2] + transform.translation_mm
    )


def test_a_reflection_is_refused():
    with pytest.raises(ValueError, match="reflection"):
        RigidTransform(np.diag([1.0, 1.0, -1.0]), np.zeros(3))


def test_what_is_not_orthonormal_is_refused():
    with pytest.raises(ValueError, match="orthonormal"):
        RigidTransform(np.eye(3) * 1.001, np.zeros(3))
    with pytest.raises(ValueError, match="orthonormal"):
        RigidTransform(np.full((3, 3), np.nan), np.zeros(3))
    with pytest.raises(ValueError, match="rotation has shape"):
        RigidTransform(np.eye(4), np.zeros(3))


def test_cross_matrix():
    v, w = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(cross_matrix(v) @ w, np.cross(v, w), atol=1e-15)
