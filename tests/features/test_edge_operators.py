"""Edge operators against equations 4.7 to 4.9, written out; isolated pixels; noise."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from closerange.errors import InputError
from closerange.features.edge_operators import (
    ROD,
    blur_minimum,
    dilation_residue_strength,
    edge_mask,
    erosion_residue_strength,
    pixel_noise,
)
from closerange.features.structuring import StructuringElement
from closerange.features.threshold import (
    NOISE_CEILING,
    edge_threshold,
    threshold_report,
    trussell_threshold,
)

CROSS = StructuringElement.disc(1)
NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0))


def written_out(image, pixel):
    """Differences of a pixel to the neighbours that are inside, in float64."""
    r, c = pixel
    inside = [
        (r + i, c + j)
        for i, j in NEIGHBOURS
        if 0 <= r + i < image.shape[0] and 0 <= c + j < image.shape[1]
    ]
    return [float(image[r, c]) - float(image[place]) for place in inside]


def blurred(image, side):
    half = side // 2
    padded = np.pad(image.astype(np.float64), half, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (side, side))
    return windows.mean(axis=(2, 3))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_residue_operators_are_equations_4_7_and_4_8(dtype):
    image = np.random.default_rng(0).integers(0, 256, (9, 11)).astype(dtype)
    erosion, dilation = erosion_residue_strength(image), dilation_residue_strength(image)
    for pixel in np.ndindex(image.shape):
        differences = written_out(image, pixel)
        assert erosion[pixel] == max(differences)
        assert dilation[pixel] == max(-d for d in differences)


@pytest.mark.parametrize("side", [1, 3, 5])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float64])
def test_blur_minimum_is_equation_4_9(dtype, side):
    image = np.random.default_rng(1).integers(0, 256, (9, 11)).astype(dtype)
    strength, soft = blur_minimum(image, blur_px=side), blurred(image, side)
    for pixel in np.ndindex(image.shape):
        differences = written_out(soft, pixel)
        expected = min(max(differences), max(-d for d in differences))
        assert strength[pixel] == pytest.approx(expected, abs=1e-4)


def test_with_its_centre_the_element_only_cuts_off_below_zero():
    image = np.random.default_rng(2).integers(0, 256, (30, 30), dtype=np.uint8)
    for operator in (erosion_residue_strength, dilation_residue_strength):
        assert operator(image, ROD).min() < 0
        assert_array_equal(operator(image, CROSS), np.maximum(operator(image, ROD), 0))
    without = blur_minimum(image, ROD)
    assert without.min() < 0
    assert_allclose(blur_minimum(image, CROSS), np.maximum(without, 0), atol=1e-5)


@pytest.mark.parametrize("sign", [1, -1])
def test_one_isolated_pixel(sign):
    """Each residue answers to a peak or a pit; blur-minimum to neither in its middle."""
    image = np.full((9, 9), 100.0)
    image[4, 4] += 90 * sign
    erosion, dilation = erosion_residue_strength(image), dilation_residue_strength(image)
    assert erosion[4, 4] == 90 * sign
    assert dilation[4, 4] == -90 * sign
    assert (erosion if sign > 0 else dilation).max() == 90
    strength = blur_minimum(image)
    assert strength[4, 4] == pytest.approx(0, abs=1e-5)
    # the blur makes a block of 3 x 3 of a ninth of the height: nothing lies between two levels
    assert np.abs(strength).max() == pytest.approx(0, abs=1e-5)


def test_ideal_step_has_strength_on_both_sides_and_nowhere_else():
    image = np.zeros((12, 12), np.uint8)
    image[:, 6:] = 90
    strength = blur_minimum(image)
    assert_allclose(strength[:, 5:7], 30, atol=1e-4)  # ramp 0, 30, 60, 90
    assert np.abs(strength[:, [0, 1, 2, 3, 4, 7, 8, 9, 10, 11]]).max() < 1e-4
    # without the blur the operator sees no ideal step at all, as section 4.4 says of it
    assert blur_minimum(image, blur_px=1).max() == 0
    assert set(np.flatnonzero(erosion_residue_strength(image)[3])) == {6}
    assert set(np.flatnonzero(dilation_residue_strength(image)[3])) == {5}


def test_offsets_and_inversion_change_nothing():
    image = np.random.default_rng(3).integers(0, 200, (20, 20), dtype=np.uint8)
    assert_allclose(blur_minimum(image + 55), blur_minimum(image), atol=1e-4)
    assert_allclose(blur_minimum(255 - image), blur_minimum(image), atol=1e-4)


def test_agrees_with_opencv_chain():
    image = np.random.default_rng(4).integers(0, 256, (40, 40), dtype=np.uint8)
    soft = cv2.blur(image.astype(np.float32), (3, 3), borderType=cv2.BORDER_REPLICATE)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    expected = np.minimum(soft - cv2.erode(soft, cross), cv2.dilate(soft, cross) - soft)
    assert_array_equal(blur_minimum(image, CROSS), expected)


@pytest.mark.parametrize("sigma", [1.0, 3.0, 10.0])
def test_pixel_noise_is_found_beside_edges_slopes_and_texture(sigma):
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:256, 0:256]
    scene = 40 + 0.3 * x + 60 * ((x // 32 + y // 32) % 2)
    image = np.clip(np.rint(scene + rng.normal(0, sigma, scene.shape)), 0, 255).astype(np.uint8)
    assert pixel_noise(image) == pytest.approx(sigma, rel=0.1)


def test_noise_free_whole_grey_values_have_the_noise_of_rounding():
    assert pixel_noise(np.zeros((9, 9), np.uint8)) == pytest.approx(12**-0.5)
    assert pixel_noise(np.zeros((9, 9), np.float32)) == 0


def test_noise_ceiling_is_what_one_pixel_in_a_thousand_exceeds():
    noise = np.random.default_rng(6).normal(0, 1, (1000, 1000)).astype(np.float32)
    share = float((blur_minimum(noise) > NOISE_CEILING).mean())
    assert 0.8e-3 < share < 1.1e-3, share  # 0.97e-3


def bright_scene(noise, seed):
    """Boxes with lit and shaded faces on a light table, after the report's bistable scene."""
    factor, size = 4, 384
    whole = np.full((size * factor, size * factor), 96.0)
    boxes = [(80, 90, 18, 62, 34), (250, 75, -20, 44, 48), (90, 270, 8, 52, 66),
             (200, 190, 40, 40, 40), (290, 280, -12, 66, 46), (195, 340, 0, 48, 26)]  # fmt: skip
    for number, (cx, cy, angle, width, height) in enumerate(boxes):
        top = cv2.boxPoints(((cx, cy), (width, height), angle))
        side = cv2.convexHull(np.vstack([top, top + np.array([14, 9])]).astype(np.float32))
        light = 125 + 10 * (number % 4)
        cv2.fillPoly(whole, [np.rint(side * factor).astype(int)], 0.5 * light)
        cv2.fillPoly(whole, [np.rint(top * factor).astype(int)], light)
    image = cv2.GaussianBlur(
        cv2.resize(whole, (size, size), interpolation=cv2.INTER_AREA), (0, 0), 0.6
    )
    image += np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [5, 6, 8])
def test_bistable_threshold_settles_at_the_upper_fixed_point(noise):
    quiet = edge_mask(bright_scene(0.5, 0))[0]
    for seed in range(3):
        image = bright_scene(noise, seed)
        whole = np.rint(np.maximum(blur_minimum(image), 0)).astype(np.uint8)  # 8 bits, as 1989
        report = edge_threshold(whole, noise=pixel_noise(image))
        low = [point for point in report.fixed_points if point < report.floor]
        assert low, report  # noise has a fixed point of its own, far below
        assert report.threshold > 2 * max(low)
        assert report.threshold in report.fixed_points
        share = float((whole > report.threshold).mean())
        assert share < 1.5 * quiet.mean()
        if noise == 8:  # the thesis' start, the mean of the image, ends at the low one
            assert trussell_threshold(whole, float(whole.mean())) in low
            assert (whole > max(low)).mean() > 4 * share
        finer = edge_mask(image)[1]  # unrounded strengths: the same answer
        assert finer.threshold == pytest.approx(report.threshold, rel=0.15)


def test_beyond_all_fixed_points_the_floor_is_the_threshold():
    noise = np.random.default_rng(7).normal(128, 10, (200, 200))
    image = np.clip(np.rint(noise), 0, 255).astype(np.uint8)
    mask, report = edge_mask(image)
    assert report.threshold == report.floor
    assert mask.mean() < 2e-3  # a thousandth, not the third that the noise's fixed point gives
    assert max(report.fixed_points) < report.floor


def test_faint_edges_are_kept_beside_highlights():
    rng = np.random.default_rng(8)
    strengths = np.concatenate(
        [rng.exponential(1, 40_000), rng.uniform(14, 20, 6000), rng.uniform(60, 80, 600)]
    ).round()
    report = edge_threshold(strengths, noise=8)
    above = [point for point in report.fixed_points if point >= report.floor]
    assert report.threshold == min(above) < 12  # between noise and faint edges
    assert max(above) > 30  # only highlights: that of the largest between-class variance
    assert threshold_report(strengths).threshold == pytest.approx(max(above), abs=0.1)


def test_a_flat_image_has_no_edges():
    mask, report = edge_mask(np.full((20, 20), 9, np.uint8))
    assert not mask.any()
    assert report.fixed_points == ()


@pytest.mark.parametrize(
    ("image", "options", "named"),
    [
        (np.zeros((4, 4), bool), {}, "bool"),
        (np.zeros(4, np.uint8), {}, "shape"),
        (np.zeros((4, 4), np.uint8), {"blur_px": 4}, "4 px"),
        (np.zeros((4, 4), np.uint8), {"blur_px": 257}, "257 px"),
        (np.array([[np.nan]]), {}, "NaN"),
    ],
)
def test_bad_images_are_refused(image, options, named):
    with pytest.raises(InputError, match=named) as refused:
        blur_minimum(image, **options)
    assert refused.value.remedy


@pytest.mark.parametrize("noise", [-1.0, np.nan, np.inf])
def test_impossible_noise_is_refused(noise):
    with pytest.raises(InputError, match="noise is"):
        edge_threshold(np.ones((3, 3)), noise=noise)


def test_strengths_that_are_not_finite_are_refused():
    with pytest.raises(InputError, match="not finite"):
        edge_threshold(np.array([[1.0, np.nan]]), noise=1.0)
