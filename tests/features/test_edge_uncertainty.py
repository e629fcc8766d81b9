"""Blur of edges and what they are not: against edges drawn by formula."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from closerange.features.edge_uncertainty import (
    BY_DIRECTION,
    FLOOR_PX,
    blur_px2,
    chain_mean,
    model_std,
)
from closerange.features.edges import find_edges

SIDE = 96


def drawn(angle, blur_px=0.7, second=(0.0, 0.0)):
    """Draw one step, or two of the same sign: the second of a given share at a distance."""
    fine = (np.arange(6) - 2.5) / 6
    row, column, down, across = np.meshgrid(
        np.arange(SIDE), np.arange(SIDE), fine, fine, indexing="ij"
    )
    way = (column + across - 47.6) * np.cos(angle) + (row + down - 47.3) * np.sin(angle)
    share, apart = second
    grey = (1 - share) * ndtr(way / blur_px) + share * ndtr((way + apart) / blur_px)
    return np.rint(40 + 150 * grey.mean(axis=(2, 3))).astype(np.uint8)


def blur_of(image):
    edges = find_edges(image)
    inner = np.abs(edges.xy_px - 47.5).max(axis=1) < 40
    blur = blur_px2(edges.width_px2, edges.normal)[inner]
    return blur.mean(), edges.width_px2[inner].mean(), edges, inner


def test_the_blur_of_ideal_edges_is_the_same_in_all_directions():
    """Within 0.09 px^2 for single angles, while their widths differ by 0.33 px^2."""
    angles = np.deg2rad([0, 10, 22.5, 35, 45, 60, 90, 120, 135])
    blur, width = np.array([blur_of(drawn(angle))[:2] for angle in angles]).T
    assert np.ptp(width) > 0.3
    assert np.ptp(blur) < 0.1
    assert abs(blur[0] - blur[4]) < 0.02, "along the rows and in the diagonal"


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4])
def test_more_blur_is_told_in_px2(angle):
    sharp, soft = (blur_of(drawn(angle, blur))[0] for blur in (0.7, 1.1))
    assert soft - sharp == pytest.approx(1.1**2 - 0.7**2, rel=0.2)


@pytest.mark.parametrize(("share", "apart"), [(0.2, 1.0), (0.3, 1.3), (0.4, 1.0)])
def test_two_steps_that_look_like_one_are_off_by_about_their_additional_blur(share, apart):
    """The reason for `OFFSET_PER_BLUR`: px per px^2 between a half and two."""
    angle = 0.4
    alone, *_ = blur_of(drawn(angle))
    blur, _, edges, inner = blur_of(drawn(angle, second=(share, apart)))
    xy = edges.xy_px[inner] - [47.6, 47.3]
    offset = -np.mean(xy @ [np.cos(angle), np.sin(angle)])
    assert blur - alone == pytest.approx(share * (1 - share) * apart**2, rel=0.4)
    assert 0.5 < offset / (blur - alone) < 2.0


def test_peaks_that_are_too_narrow_to_be_true_have_a_finite_blur():
    blur = blur_px2(np.array([0.1, 0.5, 0.6, 1e6]), np.tile([1.0, 0.0], (4, 1)))
    assert np.isfinite(blur).all()
    assert (np.diff(blur) >= 0).all()
    assert blur_px2(np.zeros(0), np.zeros((0, 2))).shape == (0,)
    diagonal = blur_px2(np.array([1.6]), np.full((1, 2), np.sqrt(0.5)))
    along = blur_px2(np.array([1.6]), np.array([[0.0, -1.0]]))
    assert diagonal - along == pytest.approx(BY_DIRECTION / 2)


def test_means_stay_on_their_chain():
    after = np.array([1, 2, 3, 4, -1, 6, -1])
    mean = chain_mean(np.array([1.0, 2, 3, 4, 5, 10, 20]), after)
    np.testing.assert_allclose(mean, [2, 2.5, 3, 3.5, 4, 15, 15])


def test_an_edge_that_moves_with_the_scale_is_less_certain():
    after = np.r_[np.arange(1, 10), -1]
    one = np.ones(10)
    still = model_std(one, 1.7 * one, 0 * one, after)
    np.testing.assert_allclose(still, FLOOR_PX)
    moving = model_std(one, 1.7 * one, 0.1 * one, after)
    assert (moving > 2 * still).all()
    np.testing.assert_array_equal(moving, model_std(one, 1.7 * one, -0.1 * one, after))
    assert model_std(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, int)).shape == (0,)
