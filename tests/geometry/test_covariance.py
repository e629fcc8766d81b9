"""Covariances against brute force and tables."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.geometry.covariance import (
    limited_part,
    mahalanobis_squared,
    positive_definite,
    propagate,
    region_limit,
)

RNG = np.random.default_rng(8)


def definite(count, size):
    root = RNG.normal(size=(count, size, size))
    return root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(size)


def test_mahalanobis_is_the_plain_formula():
    errors, cov = RNG.normal(size=(5, 3)), definite(5, 3)
    expected = [e @ np.linalg.inv(v) @ e for e, v in zip(errors, cov, strict=True)]
    np.testing.assert_allclose(mahalanobis_squared(errors, cov), expected, rtol=1e-10)


def test_mahalanobis_of_what_is_not_finite_is_nan_and_leaves_the_rest():
    errors, cov = RNG.normal(size=(3, 2)), definite(3, 2)
    whole = mahalanobis_squared(errors, cov)
    errors[0, 1], cov[2, 0, 0] = np.nan, np.inf
    squared = mahalanobis_squared(errors, cov)
    assert np.isnan(squared).tolist() == [True, False, True]
    assert squared[1] == whole[1]
    assert np.isnan(errors[0, 1])
    assert np.isinf(cov[2, 0, 0])


@pytest.mark.parametrize(
    ("dimensions", "dof", "limit"),
    [
        (3, None, 7.8147),  # chi-square tables, 95 %
        (1, None, 3.8415),
        (3, 10, 3 * 3.7083),  # F tables, 95 %
        (2, 60, 2 * 3.1504),
    ],
)
def test_region_limits_are_those_of_tables(dimensions, dof, limit):
    assert region_limit(dimensions, dof) == pytest.approx(limit, rel=2e-5)


def test_known_variance_is_the_limit_of_many_degrees_of_freedom():
    assert region_limit(3, 10**9) == pytest.approx(region_limit(3, None), rel=1e-6)
    assert region_limit(3, None, probability=0.5) < region_limit(3, None)


def test_positive_definite_needs_every_number():
    cov = definite(4, 3)
    cov[1, 0, 0], cov[2] = np.nan, -cov[2]
    cov[3] = np.ones((3, 3))
    cov[3, 2, 2] = 0.5  # an eigenvalue of 0 and one below
    assert positive_definite(cov).tolist() == [True, False, False, False]
    assert positive_definite(np.empty((0, 3, 3))).shape == (0,)


def test_a_part_within_the_whole_stays_as_it_is():
    part = definite(5, 3)
    np.testing.assert_allclose(limited_part(part, part + definite(5, 3)), part, rtol=1e-10)


def test_a_part_is_shortened_only_where_it_exceeds_the_whole():
    whole = np.diag([1.0, 4.0, 9.0])[None]
    part = np.diag([0.5, 5.0, 9.0])[None]
    np.testing.assert_allclose(limited_part(part, whole), np.diag([0.5, 4.0, 9.0])[None])
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    turned = limited_part(turn @ part @ turn.T, turn @ whole @ turn.T)
    np.testing.assert_allclose(turned, [turn @ np.diag([0.5, 4.0, 9.0]) @ turn.T], atol=1e-12)


def test_any_part_leaves_a_rest_that_is_a_covariance():
    part, whole = definite(200, 3), definite(200, 3)
    rest = whole - limited_part(part, whole)
    assert np.linalg.eigvalsh(rest).min() > -1e-10
    assert np.linalg.eigvalsh(whole - part).min() < -1


def test_a_part_of_what_is_unknown_is_unknown():
    part, whole = definite(3, 2), definite(3, 2)
    part[0, 0, 0], whole[2, 1, 1] = np.nan, -1
    assert np.isnan(limited_part(part, whole)).all(axis=(1, 2)).tolist() == [True, False, True]


def test_propagate_is_exact_for_linear_maps_and_symmetric():
    jacobian, cov = RNG.normal(size=(4, 3, 6)), definite(1, 6)[0]
    result = propagate(jacobian, cov)
    for j, v in zip(jacobian, result, strict=True):
        np.testing.assert_allclose(v, j @ cov @ j.T, rtol=1e-10)
        assert (v == v.T).all()


def test_propagate_nothing():
    assert (propagate(np.zeros((2, 3, 0)), np.zeros((0, 0))) == 0).all()
