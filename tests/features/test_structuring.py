"""Structuring elements of any shape and origin."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from closerange.errors import InputError
from closerange.features.structuring import MAX_REACH_PX, StructuringElement


def test_the_same_element_from_points_mask_and_rows():
    points = StructuringElement.of_points([(1, 0), (0, 1), (-1, 0), (0, -1)])
    mask = StructuringElement.of_mask([[0, 1, 0], [1, 0, 1], [0, 1, 0]])
    rows = StructuringElement.of_rows([[None, 0, None], [0, None, 0], [np.nan, 0, None]])
    for other in (mask, rows):
        assert_array_equal(points.offsets, other.offsets)
        assert other.flat
    assert_array_equal(points.offsets, [[-1, 0], [0, -1], [0, 1], [1, 0]])  # row-major order


def test_heights_stay_with_their_pixels():
    element = StructuringElement.of_points([(1, 0), (0, 0)], heights=[5, 2])
    assert_array_equal(element.offsets, [[0, 0], [1, 0]])
    assert_array_equal(element.heights, [2, 5])
    assert_array_equal(element.reflected.offsets, [[-1, 0], [0, 0]])
    assert_array_equal(element.reflected.heights, [5, 2])
    rows = StructuringElement.of_rows([[2, None], [5, None]], origin=(0, 0))
    assert_array_equal(rows.heights, element.heights)


def test_reflecting_twice_changes_nothing():
    element = StructuringElement.of_rows([[1, None, 3], [None, 5, 6]], origin=(4, -2))
    twice = element.reflected.reflected
    assert_array_equal(twice.offsets, element.offsets)
    assert_array_equal(twice.heights, element.heights)


@pytest.mark.parametrize("origin", [(0, 0), (1, 2), (-3, 7), (9, 9)])
def test_mask_and_origin_round_trip(origin):
    mask = np.array([[1, 0, 1], [0, 1, 1]], dtype=bool)
    element = StructuringElement.of_mask(mask, origin)
    again, where = element.mask()
    assert where == origin
    assert_array_equal(again, mask)


def test_shifting_moves_the_origin():
    element = StructuringElement.box(2, 3).shifted(5, -4)
    assert_array_equal(element.offsets.min(axis=0), [4, -5])
    assert len(element) == 6


@pytest.mark.parametrize(("radius", "count"), [(0, 1), (0.9, 1), (1, 5), (1.5, 9), (2, 13)])
def test_discs(radius, count):
    disc = StructuringElement.disc(radius)
    assert len(disc) == count
    assert_array_equal(disc.offsets, disc.reflected.offsets)


def test_arrays_are_copied_and_frozen():
    points = np.array([[0, 0], [0, 1]])
    element = StructuringElement.of_points(points)
    points[:] = 9
    assert_array_equal(element.offsets, [[0, 0], [0, 1]])
    with pytest.raises(ValueError, match="read-only"):
        element.offsets[0, 0] = 3


@pytest.mark.parametrize(
    ("build", "named"),
    [
        (lambda: StructuringElement.of_mask(np.zeros((3, 3))), "no pixel"),
        (lambda: StructuringElement.of_points([]), "no pixel"),
        (lambda: StructuringElement.disc(-1), "no pixel"),
        (lambda: StructuringElement.box(0), "no pixel"),
        (lambda: StructuringElement.box(-2, 5), "no pixel"),
        (lambda: StructuringElement.box(3, 10**9), "limit is 4097"),
        (lambda: StructuringElement.disc(np.inf), "limit is 4097"),
        (lambda: StructuringElement.disc(np.nan), "limit is 4097"),
        (lambda: StructuringElement.of_rows([[None]]), "no pixel"),
        (lambda: StructuringElement.of_points([(0, 0), (0, 0)]), "twice"),
        (lambda: StructuringElement.of_points([(0.5, 0)]), "whole numbers"),
        (lambda: StructuringElement.of_points([0, 1]), "whole numbers"),
        (lambda: StructuringElement.of_points([(0, MAX_REACH_PX + 1)]), "65537 px"),
        (lambda: StructuringElement.of_points([(0, 0)], [np.inf]), "not finite"),
        (lambda: StructuringElement.of_points([(0, 0)], [1, 2]), "2 heights for 1"),
        (lambda: StructuringElement.of_rows([[0, 0], [0]]), "lengths"),
        (lambda: StructuringElement.of_mask([1, 0, 1]), "1 axes"),
    ],
)
def test_impossible_elements_are_refused(build, named):
    with pytest.raises(InputError, match=named) as refused:
        build()
    assert refused.value.remedy
