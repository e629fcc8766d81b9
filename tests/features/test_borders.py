"""Borders against a pixel's own neighbourhood; the centroid's covariance against simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from closerange.features.borders import (
    border_centroid,
    border_centroid_covariance,
    follow_borders,
)

ROWS, COLUMNS = np.mgrid[:90, :90]


def disc(centre, radius, ratio=1.0, angle=0.0):
    x, y = COLUMNS - centre[0], ROWS - centre[1]
    along, across = (
        x * np.cos(angle) + y * np.sin(angle),
        y * np.cos(angle) - x * np.sin(angle),
    )
    return along**2 + (across / ratio) ** 2 <= radius**2


def test_border_is_the_set_of_pixels_with_a_neighbour_outside():
    mask = disc((40, 45), 20, 0.7, 0.5)
    (border,) = follow_borders(mask)
    expected = mask & ~binary_erosion(mask)  # 4-neighbours: what an 8-connected border holds
    assert {tuple(p) for p in border} == {(c, r) for r, c in np.argwhere(expected)}
    steps = np.abs(np.diff(np.vstack([border, border[:1]]), axis=0)).max(axis=1)
    assert steps.max() == 1  # closed, none left out


def test_shape_order_and_type_are_the_same_for_tiny_regions():
    mask = np.zeros((9, 9), np.uint8)
    mask[2, 3] = 1
    (border,) = follow_borders(mask)
    np.testing.assert_array_equal(border, [[3, 2]])
    assert border.dtype == np.int64


def test_diagonal_neighbours_are_one_region_and_holes_come_on_request():
    mask = np.eye(9, dtype=bool)
    assert len(follow_borders(mask)) == 1
    ring = disc((45, 45), 20) & ~disc((45, 45), 10)
    assert len(follow_borders(ring)) == 1
    assert len(follow_borders(ring, holes=True)) == 2
    assert follow_borders(np.zeros((5, 5), bool)) == []


def test_centroid_of_a_symmetric_region_is_its_middle():
    (border,) = follow_borders(disc((40, 30), 12))
    np.testing.assert_allclose(border_centroid(border), (40, 30), atol=1e-12)


@pytest.mark.parametrize("radius", [4.0, 10.0, 25.0])
def test_covariance_is_that_of_simulated_discs(radius):
    rng = np.random.default_rng(6)
    errors, covariances = [], []
    for _ in range(400):
        centre = rng.uniform(44, 46, 2)
        shape = radius * rng.uniform(0.9, 1.1), rng.uniform(0.85, 1), rng.uniform(0, 3)
        (border,) = follow_borders(disc(centre, *shape))
        errors.append(border_centroid(border) - centre)
        covariances.append(border_centroid_covariance(border))
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    # 1.60, 1.89, 2.01 measured; 2 is exact, less is on the safe side
    assert 1.3 < squares.mean() < 2.2
    assert 0.05 < np.std(errors) < 0.11
