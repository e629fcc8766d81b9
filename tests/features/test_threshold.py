"""Trussell's threshold: all fixed points by brute force, Otsu's criterion, both polarities."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from closerange.errors import InputError, SchemaError
from closerange.features.threshold import (
    fixed_points,
    threshold_documents,
    threshold_report,
    thresholds_from,
    trussell_threshold,
)


def two_levels(rng, dtype=np.uint8, low=60, high=180, share=0.1, noise=8, size=40_000):
    factor = 1 if dtype == np.uint8 else 16
    level = np.where(rng.random(size) < share, high, low)
    values = factor * (level + rng.normal(0, noise, size))
    return np.clip(np.rint(values), 0, np.iinfo(dtype).max).astype(dtype)


def mapped(pixels, threshold):
    """Equation 2.6 with the factor 1/2, from the pixels themselves."""
    return (pixels[pixels <= threshold].mean() + pixels[pixels > threshold].mean()) / 2


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("share", [0.5, 0.1, 0.9])
def test_threshold_separates_two_levels(dtype, share):
    pixels = two_levels(np.random.default_rng(1), dtype, share=share)
    factor = 1 if dtype == np.uint8 else 16
    assert trussell_threshold(pixels) == pytest.approx(120 * factor, abs=2 * factor)


def test_every_fixed_point_is_fixed_and_none_is_missing():
    rng = np.random.default_rng(2)
    pixels = np.concatenate(
        [
            two_levels(rng, low=20, high=60, share=0.02, noise=9),
            two_levels(rng, high=230, size=2000),
        ]
    )
    found = fixed_points(pixels)
    for point in found:
        assert mapped(pixels, point) == pytest.approx(point, abs=1e-9)
    brute = [
        t for t in range(int(pixels.min()), int(pixels.max())) if t <= mapped(pixels, t) < t + 1
    ]
    assert [int(point) for point in found] == brute


def bistable(rng):
    """Edge strengths: many weak ones, a few strong ones, as in an edge-strength image."""
    return np.concatenate(
        [
            rng.exponential(2.0, 40_000),
            rng.uniform(8, 30, 4_000),
            rng.uniform(100, 160, 1_500),
        ]
    ).round()


def test_bistable_iteration_is_reported_whole_and_decided_by_the_histogram():
    chosen = []
    for seed in range(6):
        pixels = bistable(np.random.default_rng(seed))
        report = threshold_report(pixels)
        best = int(np.argmax(report.between_class_variance))
        assert report.threshold == report.fixed_points[best]
        chosen.append(report.threshold)
    assert np.ptp(chosen) < 3  # noise does not make it jump


def test_between_class_variance_is_that_of_the_pixels():
    pixels = two_levels(np.random.default_rng(3))
    report = threshold_report(pixels)
    point = report.fixed_points[0]
    high = pixels > point
    share = high.mean()
    gap = pixels[high].mean() - pixels[~high].mean()
    assert report.between_class_variance[0] == pytest.approx(share * (1 - share) * gap**2)


def test_agrees_with_otsu_of_opencv():
    for seed in range(5):
        rng = np.random.default_rng(seed)
        pixels = two_levels(rng, share=rng.uniform(0.05, 0.95), noise=12).reshape(200, 200)
        otsu, _ = cv2.threshold(pixels, 0, 255, cv2.THRESH_OTSU)
        ours = trussell_threshold(pixels)
        # any threshold within the empty valley is the same: compare what they separate
        assert abs(int((pixels > ours).sum()) - int((pixels > otsu).sum())) <= 40


def test_iteration_ends_at_a_fixed_point_from_any_start():
    pixels = bistable(np.random.default_rng(0))
    report = threshold_report(pixels)
    ends = {trussell_threshold(pixels, start) for start in range(-5, 170, 5)}
    assert ends <= set(report.fixed_points)


def test_inverting_the_image_inverts_the_threshold():
    pixels = two_levels(np.random.default_rng(4), share=0.2)
    dark = 255 - pixels
    same = (pixels > trussell_threshold(pixels)) == (dark <= trussell_threshold(dark))
    assert same.mean() > 0.999


def test_noise_floor_is_respected():
    pixels = np.random.default_rng(5).exponential(2.0, 10_000)
    free = threshold_report(pixels)
    floored = threshold_report(pixels, floor=50.0)
    assert free.threshold < 50
    assert floored.threshold == 50
    assert floored.fixed_points == free.fixed_points


def test_one_grey_value_has_nothing_above_it():
    flat = np.full((5, 5), 7, np.uint8)
    assert fixed_points(flat) == ()
    assert trussell_threshold(flat) == 7
    assert trussell_threshold(flat, start=3) == 7


@pytest.mark.parametrize("pixels", [np.zeros(0, np.uint8), np.array([1.0, np.nan])])
def test_nothing_to_threshold_is_refused(pixels):
    with pytest.raises(InputError, match=r"remedy: "):
        trussell_threshold(pixels)


@pytest.mark.parametrize(("factor", "offset"), [(1 / 16, 0.0), (-1.0, 255.0)])
def test_in_other_units_it_is_the_report_of_the_other_values(factor, offset):
    rng = np.random.default_rng(2)
    low, high = two_levels(rng, low=20, high=60, share=0.02), two_levels(rng, high=230, size=2000)
    pixels = np.concatenate([low, high])
    found = threshold_report(pixels).in_units(factor, offset, image="other")
    wanted = threshold_report(factor * pixels.astype(float) + offset)
    assert found.threshold == pytest.approx(wanted.threshold)
    assert found.fixed_points == pytest.approx(wanted.fixed_points)
    assert found.between_class_variance == pytest.approx(wanted.between_class_variance)
    assert (found.floor, found.image) == (-np.inf, "other")


def test_thresholds_come_back_from_their_documents():
    pixels = two_levels(np.random.default_rng(3))
    reports = {
        ("left", "z0", ""): threshold_report(pixels),
        ("right", "z0", "2"): threshold_report(pixels, floor=7.5).in_units(0.5, image="top-hat"),
    }
    documents = json.loads(json.dumps(threshold_documents(reports), allow_nan=False))
    assert thresholds_from(documents) == reports
    for broken in ([{}], [{**documents[0], "threshold": "high"}], ["x"], 3):
        with pytest.raises(SchemaError, match="thresholds: malformed"):
            thresholds_from(broken)
