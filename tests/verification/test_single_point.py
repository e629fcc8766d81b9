"""The single-point test where bias, repeatability and prediction are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from closerange.errors import DataError, InputError
from closerange.features.control import ControlPoints
from closerange.flags import Flag
from closerange.position.measure import measure_points
from closerange.position.positions import Positions
from closerange.verification.judgement import Limits
from closerange.verification.scenes import observe, random_positions, rig_b
from closerange.verification.single_point import single_point_test

NOISE = np.array([0.004, 0.006, 0.012])
BIAS = 0.03


def readings_of(truth, xyz, *, cov=np.nan, flags=0):
    """Make positions from (readings, positions, 3)."""
    readings, count = xyz.shape[:2]
    rows = readings * count
    return Positions(
        placement=truth.placement * readings,
        point=truth.point * readings,
        xyz_mm=xyz.reshape(-1, 3),
        cov_mm2=np.broadcast_to(cov, (rows, 3, 3)),
        residual_px=np.full(rows, np.nan),
        cameras=np.full(rows, 2),
        flags=np.broadcast_to(flags, (rows,)),
        reading=tuple(str(i + 1) for i in range(readings) for _ in range(count)),
    )


@pytest.fixture(scope="module")
def simulated():
    """90 positions x 10 readings with known noise and a bias that differs by position."""
    rng = np.random.default_rng(11)
    truth = random_positions(90, [[-6.35] * 3, [6.35] * 3], rng)
    bias = BIAS * rng.standard_normal((90, 3))
    bias[:, 0] += 0.01 * truth.xyz_mm[:, 2]
    xyz = truth.xyz_mm + bias + NOISE * rng.standard_normal((10, 90, 3))
    return truth, bias, xyz


def test_figures_of_merit_are_those_put_in(simulated):
    truth, bias, xyz = simulated
    report = single_point_test(readings_of(truth, xyz), truth, cycle_time_s=0.4)
    assert len(report) == 90
    assert report.count.tolist() == [10] * 90
    pooled = report.repeatability.pooled
    assert pooled.dof == 810
    assert pooled.std_mm == pytest.approx(NOISE, rel=3 * pooled.relative_uncertainty)
    assert report.error_mm == pytest.approx(truth.xyz_mm - xyz.mean(axis=0))
    assert report.accuracy.max_mm[:3] == pytest.approx(np.abs(bias).max(axis=0), abs=0.012)
    assert report.std_mm == pytest.approx(xyz.std(axis=0, ddof=1))
    assert report.range_mm == pytest.approx(np.ptp(xyz, axis=0))
    assert report.cycle_time_s == 0.4
    assert report.decision is None
    assert "90 positions" in str(report)


def test_error_has_the_sign_of_the_thesis(simulated):
    truth, _, xyz = simulated
    report = single_point_test(readings_of(truth, xyz + np.array([1.0, 0, 0])), truth)
    assert report.accuracy.bias_mm[0] == pytest.approx(-1.0, abs=0.02)


def test_x_error_that_follows_z_is_found(simulated):
    truth, _, xyz = simulated
    slopes = single_point_test(readings_of(truth, xyz), truth).slopes
    assert slopes.slope[0, 2] == pytest.approx(-0.01, abs=3 * slopes.std[0, 2])
    assert slopes.p_value[0, 2] < 1e-6


def test_worst_values_are_those_of_luck_when_nothing_else_acts():
    rng = np.random.default_rng(12)
    truth = random_positions(90, [[0] * 3, [10] * 3], rng)
    report = single_point_test(
        readings_of(truth, truth.xyz_mm + NOISE * rng.standard_normal((10, 90, 3))), truth
    )
    worst = report.repeatability.worst_std_mm / report.repeatability.pooled.std_mm
    assert report.luck.worst_std.mean == pytest.approx(1.59, abs=0.005)
    assert ((worst > 1.3) & (worst < 2.0)).all(), worst
    in_sigma = report.accuracy.max_mm[:3] / (NOISE / np.sqrt(10))
    assert ((in_sigma > 1.9) & (in_sigma < 4.1)).all(), in_sigma


@pytest.mark.parametrize("stated", [True, False])
def test_prediction_splits_calibration_and_noise(stated):
    """Calibration 0.01, noise 0.02: the mean of ten readings keeps 0.01 and 0.02 / sqrt(10)."""
    rng = np.random.default_rng(13)
    truth = random_positions(400, [[0] * 3, [10] * 3], rng)
    fixed = 0.01 * rng.standard_normal((400, 3))
    xyz = truth.xyz_mm + fixed + 0.02 * rng.standard_normal((10, 400, 3))
    positions = readings_of(truth, xyz, cov=(0.01**2 + 0.02**2) * np.eye(3))
    noise = 0.02**2 * np.eye(3) if stated else None
    report = single_point_test(positions, truth, noise_cov_mm2=noise)
    expected = 0.01**2 + 0.02**2 / 10
    variance = report.predicted_cov_mm2[:, 0, 0]
    assert variance == pytest.approx(np.full(400, expected), rel=0.12)
    assert report.prediction.noise_share == pytest.approx(0.8, abs=0.02)
    # 400 positions: 3.5 % standard error along an axis
    assert report.prediction.accuracy_ratio == pytest.approx(np.ones(4), abs=0.11)
    assert report.coverage.share == pytest.approx(0.95, abs=0.035)
    against = 1.0 if stated else np.sqrt(0.8)
    assert report.prediction.repeatability_ratio == pytest.approx(np.full(4, against), rel=0.05)
    assert report.prediction.noise_stated is stated


def test_noise_comes_from_the_positions_if_all_readings_state_it(simulated):
    truth, _, xyz = simulated
    positions = readings_of(truth, xyz, cov=(BIAS**2 + 0.012**2) * np.eye(3))
    stated = np.broadcast_to(np.diag(NOISE**2), (len(positions), 3, 3)).copy()
    carried = single_point_test(replace(positions, noise_cov_mm2=stated), truth)
    given = single_point_test(positions, truth, noise_cov_mm2=stated)
    assert carried.prediction.noise_stated
    np.testing.assert_array_equal(carried.predicted_cov_mm2, given.predicted_cov_mm2)
    # 810 degrees of freedom: 2.5 % standard error
    assert carried.prediction.repeatability_ratio == pytest.approx(np.ones(4), abs=0.08)
    stated[17] = np.nan
    assert not single_point_test(
        replace(positions, noise_cov_mm2=stated), truth
    ).prediction.noise_stated


def test_noise_of_a_reading_that_is_left_out_need_not_be_known(simulated):
    truth, _, xyz = simulated
    flags = np.zeros(xyz.shape[:2], np.int64)
    flags[3, 17] = int(Flag.residual)
    positions = readings_of(truth, xyz, cov=np.eye(3), flags=flags.ravel())
    stated = np.broadcast_to(np.diag(NOISE**2), (len(positions), 3, 3)).copy()
    stated[flags.ravel() != 0] = np.nan
    with pytest.warns(UserWarning, match="1 of 900 readings are flagged and were left out"):
        report = single_point_test(replace(positions, noise_cov_mm2=stated), truth)
    assert report.prediction.noise_stated


def test_noise_beyond_the_whole_covariance_leaves_a_covariance(simulated):
    """Both are estimates: where the noise is larger, nothing is left that readings share."""
    truth, _, xyz = simulated
    total = np.diag([0.02, 0.005, 0.02]) ** 2
    positions = readings_of(truth, xyz, cov=total)
    report = single_point_test(positions, truth, noise_cov_mm2=0.01**2 * np.eye(3))
    expected = [0.02**2 - 0.9 * 0.01**2, 0.1 * 0.005**2, 0.02**2 - 0.9 * 0.01**2]
    np.testing.assert_allclose(report.predicted_cov_mm2, [np.diag(expected)] * 90, atol=1e-15)


def test_region_of_a_mean_of_ten_readings_holds_with_stated_noise():
    """Every image point has an error that all readings share, beside noise half as large."""
    rig, rng = rig_b(), np.random.default_rng(16)
    truth = random_positions(400, rig.volume_mm, rng)
    points = observe(rig.cameras, truth, noise_px=0.05, rng=rng, readings=10)
    common = np.broadcast_to(0.1 * rng.standard_normal((2, 1, 400, 2)), (2, 10, 400, 2))
    shape = (len(points), 2, 2)
    points = replace(
        points,
        xy_px=points.xy_px + common.reshape(-1, 2),
        cov_px2=np.broadcast_to((0.1**2 + 0.05**2) * np.eye(2), shape),
        noise_cov_px2=np.broadcast_to(0.05**2 * np.eye(2), shape),
    )
    report = single_point_test(measure_points(rig.true_rig(), points), truth)
    assert report.coverage.share == pytest.approx(0.95, abs=0.033)  # three standard errors
    assert report.prediction.accuracy_ratio == pytest.approx(np.ones(4), abs=0.11)
    assert report.prediction.repeatability_ratio == pytest.approx(np.ones(4), abs=0.04)


def test_measured_readings_of_a_true_rig_are_all_noise():
    rig = rig_b()
    truth = random_positions(60, rig.volume_mm, np.random.default_rng(14))
    seen = observe(
        rig.cameras, truth, noise_px=rig.noise_px, rng=np.random.default_rng(15), readings=5
    )
    positions = measure_points(rig.true_rig(), seen)
    report = single_point_test(positions, truth)
    assert report.prediction.noise_share == pytest.approx(1.0, abs=0.1)
    assert report.prediction.accuracy_ratio == pytest.approx(np.ones(4), abs=0.3)
    assert 0.85 < report.coverage.share <= 1.0


def test_one_reading_has_no_standard_deviation(simulated):
    truth, _, xyz = simulated
    with pytest.warns(UserWarning, match="90 of 90 positions have one reading"):
        report = single_point_test(
            readings_of(truth, xyz[:1]), truth, limits=Limits.of(repeatability_mm=1.0)
        )
    assert np.isnan(report.std_mm).all()
    assert np.isnan(report.repeatability.pooled.std_mm).all()
    assert report.decision == "undecided"
    assert any("as few as 1 readings" in text for text in report.deviations)
    document = report.to_document()
    assert document["rows"]["std_mm"][0] == [None] * 3


def test_frozen_readings_are_flagged_and_not_accepted(simulated):
    truth, _, xyz = simulated
    xyz = xyz.copy()
    xyz[:, 7] = xyz[0, 7]
    limits = Limits.of(accuracy_mm=1.0, repeatability_mm=1.0)
    with pytest.warns(UserWarning, match="all readings of 1 of 90 positions are equal"):
        report = single_point_test(readings_of(truth, xyz), truth, limits=limits)
    assert report.flags.nonzero()[0].tolist() == [7]
    assert report.flags[7] == Flag.frozen
    assert not report.std_mm[7].any()
    assert report.repeatability.pooled.dof == 89 * 9
    assert {item.decision for item in report.judgements} == {"accept"}
    assert report.decision == "undecided"


def test_untrusted_positions_are_not_accepted(simulated):
    truth, _, xyz = simulated
    positions = readings_of(truth, xyz, flags=int(Flag.untrusted))
    with pytest.warns(UserWarning, match="untrustworthy rig"):
        report = single_point_test(positions, truth, limits=Limits.of(accuracy_mm=1.0))
    assert report.decision == "undecided"


@pytest.mark.parametrize(
    ("factor", "decision"), [(1.5, "accept"), (1.001, "undecided"), (0.8, "reject")]
)
def test_decision_has_a_guard_band(simulated, factor, decision):
    truth, _, xyz = simulated
    positions = readings_of(truth, xyz)
    worst = single_point_test(positions, truth).accuracy.max_mm[:3]
    report = single_point_test(
        positions, truth, limits=Limits.of(accuracy_mm=factor * worst), gauge_std_mm=0.002
    )
    # one-sided 95 % of the normal distribution
    guards = [item.guard for item in report.judgements]
    assert guards == pytest.approx([1.6449 * 0.002] * 3, rel=1e-4)
    assert report.decision == decision


def test_coarse_reference_is_warned_about(simulated):
    """The thesis' dial (0.0127 mm) proves nothing below 0.05 mm."""
    truth, _, xyz = simulated
    with pytest.warns(UserWarning, match="proves nothing below 0.0508 mm"):
        single_point_test(
            readings_of(truth, xyz),
            truth,
            limits=Limits.of(accuracy_mm=[0.05, 0.5, np.nan]),
            gauge_std_mm=0.0127,
        )


def test_unknown_cycle_time_cannot_meet_its_limit(simulated):
    truth, _, xyz = simulated
    positions, limits = readings_of(truth, xyz), Limits.of(cycle_time_s=0.5)
    found = [
        single_point_test(positions, truth, limits=limits, cycle_time_s=time).decision
        for time in (None, 0.4, 0.6)
    ]
    assert found == ["undecided", "accept", "reject"]


def test_deviations_from_the_procedure_are_listed():
    grid = np.array([[x, y, 0.0] for x in range(3) for y in range(3)])
    truth = ControlPoints.of([f"p{i}" for i in range(9)], grid)
    xyz = grid + np.random.default_rng(0).standard_normal((3, 9, 3))
    text = "\n".join(single_point_test(readings_of(truth, xyz), truth).deviations)
    for part in (
        "9 positions instead of 90",
        "as few as 3 readings",
        "regular steps",
        "cycle time is unknown",
        "taken as exact",
        "target plate",
    ):
        assert part in text


def test_full_random_test_deviates_only_where_the_program_cannot_know(simulated):
    truth, _, xyz = simulated
    report = single_point_test(readings_of(truth, xyz), truth, cycle_time_s=0.4, gauge_std_mm=0.001)
    assert len(report.deviations) == 2, report.deviations


def test_flagged_and_unknown_readings_are_left_out_and_listed(simulated):
    truth, _, xyz = simulated
    spoiled = xyz.copy()
    spoiled[0, 0] += 100.0
    flags = np.zeros(900, int)
    flags[0] = int(Flag.residual)
    shorter = ControlPoints.of(truth.point[:-1], truth.xyz_mm[:-1])
    with pytest.warns(UserWarning, match="left out|no actual position"):
        report = single_point_test(readings_of(truth, spoiled, flags=flags), shorter)
    assert report.left_out == (("", "1", truth.point[0], "residual"),)
    assert report.count[0] == 9
    assert len(report.missing) == 10
    assert len(report) == 89
    assert report.accuracy.max_mm.max() < 1.0


def test_bad_arguments_are_refused(simulated):
    truth, _, xyz = simulated
    positions = readings_of(truth, xyz)
    with pytest.raises(InputError, match="gauge_std_mm is -1"):
        single_point_test(positions, truth, gauge_std_mm=-1.0)
    with pytest.raises(DataError, match="none of 900 readings"):
        single_point_test(positions, ControlPoints.of(["x"], np.zeros((1, 3))))
    with pytest.raises(InputError, match="must exceed 0"):
        Limits.of(accuracy_mm=0.0)
    with pytest.raises(InputError, match="shape"):
        Limits.of(accuracy_mm=[1.0, 2.0])
