"""Statistics against closed forms, the metrology report and simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from closerange.verification.statistics import (
    axis_slopes,
    half_range_by_luck,
    pooled_std,
    region_coverage,
    summarise_errors,
    worst_error_by_luck,
    worst_std_by_luck,
)


def test_luck_of_a_test_of_90_positions_is_that_of_the_report():
    worst_std, worst_error = worst_std_by_luck(90, 10), worst_error_by_luck(90)
    assert worst_std.mean == pytest.approx(1.59, abs=0.005)
    assert worst_error.mean == pytest.approx(2.71, abs=0.005)
    # the report's interval was simulated: its last digit is uncertain
    assert (worst_error.low, worst_error.high) == pytest.approx((2.05, 3.62), abs=0.015)
    assert half_range_by_luck(90) == pytest.approx(2.47, abs=0.005)


def test_luck_has_its_closed_forms():
    assert worst_error_by_luck(1).mean == pytest.approx(np.sqrt(2 / np.pi), rel=1e-8)
    assert half_range_by_luck(2) == pytest.approx(1 / np.sqrt(np.pi), rel=1e-8)
    # one standard deviation of two readings: the mean of a half-normal value
    assert worst_std_by_luck(1, 2).mean == pytest.approx(np.sqrt(2 / np.pi), rel=1e-8)


def test_luck_by_simulation():
    rng = np.random.default_rng(0)
    worst = rng.standard_normal((4000, 20, 5)).std(axis=2, ddof=1).max(axis=1)
    luck = worst_std_by_luck(20, 5)
    assert worst.mean() == pytest.approx(luck.mean, abs=4 * worst.std() / np.sqrt(4000))
    assert np.mean((worst > luck.low) & (worst < luck.high)) == pytest.approx(0.95, abs=0.014)


def test_luck_without_readings_is_unknown():
    assert np.isnan(worst_std_by_luck(90, 1).mean)
    assert np.isnan(worst_error_by_luck(0).mean)
    assert np.isnan(half_range_by_luck(1))


def test_pooled_std_of_the_standard_test_is_known_to_two_and_a_half_percent():
    pooled = pooled_std(np.full((90, 3), 2.0), np.full(90, 10))
    assert pooled.std_mm == pytest.approx(np.full(3, 2.0))
    assert pooled.dof == 810
    assert pooled.relative_uncertainty == pytest.approx(0.025, abs=0.0002)


def test_pooled_std_weighs_groups_by_their_freedom():
    pooled = pooled_std([[1.0] * 3, [2.0] * 3, [np.nan] * 3], [2, 4, 1])
    assert pooled.dof == 4
    assert pooled.std_mm == pytest.approx(np.full(3, np.sqrt((1 + 3 * 4) / 4)))


def test_single_readings_have_no_pooled_std():
    pooled = pooled_std(np.full((3, 3), np.nan), [1, 1, 1])
    assert pooled.dof == 0
    assert np.isnan(pooled.std_mm).all()


def test_summary_of_known_errors():
    summary = summarise_errors([[3, 0, 0], [-1, 4, 0], [np.nan, 0, 0]])
    assert summary.count == 2
    assert summary.bias_mm == pytest.approx([1, 2, 0])
    assert summary.mean_abs_mm == pytest.approx([2, 2, 0, (3 + np.sqrt(17)) / 2])
    assert summary.rms_mm == pytest.approx([np.sqrt(5), np.sqrt(8), 0, np.sqrt(13)])
    assert summary.max_mm == pytest.approx([3, 4, 0, np.sqrt(17)])
    assert summary.half_range_mm == pytest.approx([2, 2, 0])


def test_summary_of_nothing_is_unknown():
    summary = summarise_errors(np.empty((0, 3)))
    assert summary.count == 0
    assert np.isnan(summary.rms_mm).all()


def test_slopes_agree_with_scipy_for_one_coordinate():
    rng = np.random.default_rng(1)
    xyz = np.zeros((30, 3))
    xyz[:, 2] = rng.uniform(-5, 5, 30)
    error = rng.standard_normal((30, 3)) * 0.01
    error[:, 0] += 0.02 * xyz[:, 2]
    slopes = axis_slopes(error, xyz)
    for axis in range(3):
        reference = stats.linregress(xyz[:, 2], error[:, axis])
        found = slopes.slope[axis, 2], slopes.std[axis, 2], slopes.p_value[axis, 2]
        assert found == pytest.approx((reference.slope, reference.stderr, reference.pvalue))
        assert slopes.explained[axis] == pytest.approx(reference.rvalue**2)
    assert np.isnan(slopes.slope[:, :2]).all()
    assert slopes.dof == 28


def test_x_error_that_follows_z_is_found_and_nothing_else():
    """Section 3.5 of the thesis, simulated: 90 positions, a slope of 5 um per mm."""
    rng = np.random.default_rng(2)
    xyz = rng.uniform(-6.35, 6.35, (90, 3))
    error = 0.02 * rng.standard_normal((90, 3))
    error[:, 0] += 0.005 * xyz[:, 2]
    slopes = axis_slopes(error, xyz)
    assert slopes.slope[0, 2] == pytest.approx(0.005, abs=3 * slopes.std[0, 2])
    assert slopes.p_value[0, 2] < 1e-6
    others = np.delete(slopes.p_value.ravel(), 2)
    assert (others > 0.01).all(), others


def test_slopes_of_confounded_or_too_few_positions_are_unknown():
    line = np.linspace(0, 1, 10)[:, None] * [1.0, 2.0, 3.0]
    assert np.isnan(axis_slopes(np.ones((10, 3)), line).slope).all()
    assert np.isnan(axis_slopes(np.ones((3, 3)), np.eye(3)).slope).all()
    assert np.isnan(axis_slopes(np.empty((0, 3)), np.empty((0, 3))).slope).all()


@pytest.mark.parametrize("dof", [None, 12])
def test_coverage_holds_for_errors_from_the_stated_distribution(dof):
    rng = np.random.default_rng(3)
    root = np.array([[2.0, 0, 0], [0.5, 1.0, 0], [0.1, -0.3, 0.4]])
    error = rng.standard_normal((4000, 3)) @ root.T
    cov = np.broadcast_to(root @ root.T, (4000, 3, 3))
    if dof:
        cov = cov * (rng.chisquare(dof, 4000) / dof)[:, None, None]
    coverage = region_coverage(error, cov, dof=dof)
    assert coverage.count == 4000
    assert coverage.share == pytest.approx(0.95, abs=0.011)  # three standard errors
    if dof is None:
        assert coverage.mean_ratio == pytest.approx(1.0, abs=0.04)


def test_coverage_interval_is_that_of_the_binomial_distribution():
    error = np.zeros((20, 3))
    error[:2] = 100.0
    coverage = region_coverage(error, np.broadcast_to(np.eye(3), (20, 3, 3)))
    interval = stats.binomtest(18, 20).proportion_ci(0.95, method="exact")
    assert (coverage.low, coverage.high) == pytest.approx((interval.low, interval.high))


def test_coverage_leaves_out_what_has_no_covariance():
    cov = np.stack([np.eye(3), np.full((3, 3), np.nan), np.zeros((3, 3))])
    coverage = region_coverage(np.zeros((3, 3)), cov)
    assert (coverage.count, coverage.share) == (1, 1.0)
    assert np.isnan(region_coverage(np.zeros((1, 3)), np.zeros((1, 3, 3))).share)
