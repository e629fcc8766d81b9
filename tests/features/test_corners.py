"""Corners: intersections of straight pieces of edges."""

from __future__ import annotations

import cv2
import numpy as np

from closerange.features.corners import find_corners
from closerange.features.edges import find_edges


def polygon(corners, *, noise=1.5, seed=0, size=(120, 140), fine=16):
    """Draw a bright polygon by supersampling."""
    points = np.rint((np.asarray(corners) + 0.5) * fine - 0.5).astype(np.int32)
    large = np.full((size[0] * fine, size[1] * fine), 50, np.uint8)
    cv2.fillPoly(large, [points], 190)
    grey = large.reshape(size[0], fine, size[1], fine).mean(axis=(1, 3))
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7)
    grey += np.random.default_rng(seed).normal(0, noise, grey.shape)
    return np.rint(grey).astype(np.uint8)


def corners_of(image):
    return find_corners(image, find_edges(image))


def test_corners_of_turned_squares_lie_where_they_were_drawn():
    """Stated covariances hold: the squared errors are chi-squared with two degrees of freedom."""
    errors, squared = [], []
    for seed, turn in enumerate(np.deg2rad([7.0, 21.0, 33.0, 52.0, 68.0, 81.0])):
        c, s = np.cos(turn), np.sin(turn)
        square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 31.3 @ [[c, s], [-s, c]]
        square += [69.4 + 0.13 * seed, 60.2 + 0.29 * seed]
        found = corners_of(polygon(square, seed=seed))
        assert len(found) == 4
        apart = np.linalg.norm(found.xy_px[:, None] - square, axis=2)
        miss = found.xy_px - square[apart.argmin(axis=1)]
        errors += np.linalg.norm(miss, axis=1).tolist()
        squared += np.einsum("ni,nij,nj->n", miss, np.linalg.inv(found.cov_px2), miss).tolist()
    assert np.max(errors) < 0.3
    assert np.mean(errors) < 0.1
    assert np.mean(np.array(squared) < 5.99) >= 0.9


def test_blunt_corners_are_found_and_sharp_ones_left_out():
    """Between arms at 40 degrees the blur of each moves the other: such a corner is not stated."""
    roof = np.array([[14.3, 88.2], [70.1, 50.6], [124.7, 91.4]])
    found = corners_of(polygon(roof, seed=3))
    assert len(found) == 1
    assert np.linalg.norm(found.xy_px[0] - roof[1]) < 0.2


def test_circles_bars_and_noise_have_no_corners():
    y, x = np.mgrid[0:120, 0:140]
    rng = np.random.default_rng(0)
    disc = 50 + 120 * np.clip(30.5 - np.hypot(x - 70.2, y - 59.7), 0, 1)
    edge = np.where(x + 0.2 * y < 80, 50.0, 180.0)
    for grey in (disc, edge, np.full(x.shape, 90.0)):
        soft = cv2.GaussianBlur(grey, (0, 0), 0.7) + rng.normal(0, 1.5, grey.shape)
        found = corners_of(np.rint(soft).astype(np.uint8))
        assert len(found) == 0
        assert found.cov_px2.shape == (0, 2, 2)


def test_arms_name_the_edge_points_and_their_way_from_the_corner():
    square = np.array([[30.0, 30.0], [100.0, 34.0], [96.0, 90.0], [28.0, 86.0]])
    image = polygon(square, seed=5)
    edges = find_edges(image)
    found = find_corners(image, edges)
    assert len(found) == 4
    assert found.xy_px[:, 1].tolist() == sorted(found.xy_px[:, 1])
    for number in range(4):
        mine = found.corner == number
        assert set(found.arm[mine]) == {0, 1}
        way = edges.xy_px[found.point[mine]] - found.xy_px[number]
        np.testing.assert_allclose(np.linalg.norm(way, axis=1), found.along_px[mine])
        # an edge runs towards its corner
        turn = np.abs(np.einsum("ni,ni->n", way, edges.normal[found.point[mine]]))
        assert turn.max() < 1.0
