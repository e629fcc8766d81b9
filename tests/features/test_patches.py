"""Bright faces and their centroids."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import pytest

from closerange.features.patches import area_centroid, find_patches


def drawn(shapes, *, size=(240, 200), noise=1.0, ground=30):
    """Draw convex polygons in given greys, 8 x 8 times finer, blurred, with noise."""
    fine = np.full((size[1] * 8, size[0] * 8), ground, np.uint8)
    # pixel (0, 0) is a centre: its corner lies at (-0.5, -0.5)
    x, y = (np.arange(8 * side) / 8 + 1 / 16 - 0.5 for side in size)
    for corners, grey in shapes:
        inside = np.ones(fine.shape, bool)
        for (ax, ay), (bx, by) in pairwise([*corners, corners[0]]):
            inside &= (bx - ax) * (y[:, None] - ay) - (by - ay) * (x - ax) >= 0
        fine[inside] = grey
    grey = cv2.resize(fine, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7) + np.random.default_rng(2).normal(
        0, noise, grey.shape
    )
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


TOP = [(40.0, 30.0), (110.0, 50.0), (95.0, 120.0), (25.0, 100.0)]
SIDE = [(25.0, 100.0), (95.0, 120.0), (95.0, 150.0), (25.0, 130.0)]
SMALL = [(150.0, 60.0), (190.0, 60.0), (190.0, 90.0), (150.0, 90.0)]


def test_the_centroid_of_a_polygon():
    area, centroid = area_centroid(np.array([[1, 1], [5, 1], [5, 3], [1, 3]], float))
    assert area == 8
    assert centroid.tolist() == [3, 2]
    # either way round; and a triangle's is the mean of its corners
    triangle = np.array([[0, 0], [0, 6], [9, 0]], float)
    assert area_centroid(triangle)[0] == 27
    np.testing.assert_allclose(area_centroid(triangle)[1], [3, 2])


def test_a_line_has_no_area():
    area, centroid = area_centroid(np.array([[0, 0], [4, 4], [2, 2]], float))
    assert area == 0
    assert centroid.tolist() == [2, 2]


def test_faces_are_found_from_the_largest_to_the_smallest():
    found = find_patches(drawn([(TOP, 190), (SMALL, 170)]))
    assert len(found) == 2
    for row, corners in enumerate((TOP, SMALL)):
        area, centroid = area_centroid(np.array(corners))
        # a border is placed to some 0.05 px; corners are rounded by the blur
        np.testing.assert_allclose(found.xy_px[row], centroid, atol=0.05)  # measured 0.02
        assert found.area_px[row] == pytest.approx(area, rel=0.01)


def test_a_top_is_parted_from_its_darker_side():
    found = find_patches(drawn([(SIDE, 105), (TOP, 190)]))
    assert len(found) == 1
    np.testing.assert_allclose(found.xy_px[0], area_centroid(np.array(TOP))[1], atol=0.1)


def test_a_face_under_slanting_light_stays_whole():
    image = drawn([(TOP, 160)], noise=0).astype(float)
    slope = 0.3 * (np.arange(image.shape[1]) - 70)
    image = np.where(image > 100, image + slope, image) + np.random.default_rng(3).normal(
        0, 1, image.shape
    )
    found = find_patches(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert len(found) == 1
    np.testing.assert_allclose(found.xy_px[0], area_centroid(np.array(TOP))[1], atol=0.15)


def test_what_touches_the_border_is_no_whole_face():
    cut = [(-10.0, 20.0), (60.0, 20.0), (60.0, 90.0), (-10.0, 90.0)]
    found = find_patches(drawn([(cut, 190), (SMALL, 190)]))
    assert len(found) == 1
    np.testing.assert_allclose(found.xy_px[0], [170, 75], atol=0.05)


def test_noise_has_no_faces():
    image = np.clip(np.random.default_rng(4).normal(60, 10, (150, 150)), 0, 255).astype(np.uint8)
    assert len(find_patches(image)) == 0


def test_a_strip_of_a_brighter_side_is_cut_off():
    """One corner of the side is brighter than the image's threshold, the rest is not."""
    image = drawn([(SIDE, 60), ([(25.0, 100.0), (45.0, 106.0), (45.0, 112.0), (25.0, 106.0)], 115),
                   (TOP, 190)])  # fmt: skip
    found = find_patches(image)
    np.testing.assert_allclose(found.xy_px[0], area_centroid(np.array(TOP))[1], atol=0.1)
