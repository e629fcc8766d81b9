"""What is left out, missing or never measured: nothing is accepted, however good the rest."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from closerange.delivery.front_page import verdict
from closerange.delivery.sheet import Contents
from closerange.errors import CloseRangeWarning, InputError
from closerange.features.control import ControlPoints
from closerange.flags import Flag
from closerange.position.positions import Positions
from closerange.position.positions_table import read_positions
from closerange.verification.control_check import compare_with_control
from closerange.verification.judgement import Limits
from closerange.verification.lengths import Lengths, length_test
from closerange.verification.single_point import single_point_test

LIMITS = Limits.of(accuracy_mm=1.0, repeatability_mm=1.0)
BAD = int(Flag.residual)
COUNT, READINGS = 90, 3


def readings(*, count=COUNT, flagged=0, seed=0, dof=None):
    """Make truth and readings, of which the last ones are flagged and far off."""
    rng = np.random.default_rng(seed)
    truth = ControlPoints.of([f"p{i}" for i in range(COUNT)], rng.uniform(-50, 50, (COUNT, 3)))
    rows = count * READINGS
    flags = np.where(np.arange(rows) >= rows - flagged, BAD, 0)
    xyz = np.repeat(truth.xyz_mm[:count], READINGS, axis=0)
    xyz = xyz + 0.01 * rng.standard_normal((rows, 3)) + np.where(flags != 0, 40.0, 0.0)[:, None]
    names = [f"p{i}" for i in range(count) for _ in range(READINGS)]
    positions = Positions(
        placement=("",) * rows,
        point=tuple(names),
        xyz_mm=xyz,
        cov_mm2=np.broadcast_to(0.01**2 * np.eye(3), (rows, 3, 3)),
        residual_px=np.zeros(rows),
        cameras=np.full(rows, 2),
        flags=flags,
        reading=tuple(str(i) for _ in range(count) for i in range(READINGS)),
        dof=dof,
    )
    return positions, truth


def judged(positions, truth, *, limits=LIMITS):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        return single_point_test(positions, truth, limits=limits)


def sentence(result):
    return verdict(Contents(title="t", checks=(result.to_document(),)))


def test_a_whole_test_is_accepted():
    report = judged(*readings())
    assert (report.decision, report.reservations, report.hollow) == ("accept", (), "")
    assert sentence(report).tone == "good"


def test_exchanged_cameras_leave_six_readings_that_are_not_accepted():
    """The case of the review: 264 of 270 flagged, one reading each of six positions."""
    positions, truth = readings()
    good = np.arange(len(positions)) % 45 == 0
    flagged = Positions(
        positions.placement, positions.point, positions.xyz_mm, positions.cov_mm2,
        positions.residual_px, positions.cameras, np.where(good, 0, BAD), positions.reading,
    )  # fmt: skip
    report = judged(flagged, truth, limits=Limits.of(accuracy_mm=1.0))
    assert [item.decision for item in report.judgements] == ["accept"] * 3
    assert report.decision == "undecided"
    assert report.reservations == (
        "264 of 270 readings are flagged and were left out",
        "84 of 90 actual positions have no usable reading",
    )
    assert report.hollow.startswith("264 of 270 readings could not be used: the 6 that remain")
    text = sentence(report).text
    assert text.startswith("Undecided: 264 of 270 readings are flagged and were left out; 84 of 90")
    # without limits there is a decision too: that nothing can be said
    assert judged(flagged, truth, limits=None).decision == "undecided"


def test_one_flagged_reading_is_enough_to_leave_it_undecided():
    report = judged(*readings(flagged=1))
    assert report.decision == "undecided"
    assert report.reservations == ("1 of 270 readings are flagged and were left out",)
    assert report.not_measured == ()
    assert report.hollow == ""
    assert sentence(report).tone == "warn"


def test_a_truth_that_was_never_measured_is_enough():
    report = judged(*readings(count=89))
    assert report.decision == "undecided"
    assert report.not_measured == (("", "p89"),)


def test_a_reading_without_a_truth_is_enough():
    positions, truth = readings()
    shorter = ControlPoints.of(truth.point[:-1], truth.xyz_mm[:-1])
    report = judged(positions, shorter)
    assert report.decision == "undecided"
    assert report.reservations == ("3 readings have no actual position",)


def test_what_was_left_out_does_not_save_from_rejection():
    report = judged(*readings(flagged=1), limits=Limits.of(accuracy_mm=1e-4))
    assert report.decision == "reject"


def test_without_limits_the_sentence_says_what_was_left_out():
    report = judged(*readings(flagged=1), limits=None)
    assert report.decision is None
    found = sentence(report)
    assert "no limits were agreed; but 1 of 270 readings are flagged" in found.text
    assert found.tone == "warn"


def test_a_truth_for_all_placements_counts_when_its_point_is_measured_in_one():
    """A row of the same placement wins: the row for all of them is then never looked up."""
    truth = ControlPoints.of(["a", "a"], [[0, 0, 0], [1, 0, 0]], placement=["", "s"])
    positions = Positions(
        ("s", "s"), ("a", "a"), [[1, 0, 0], [1, 0.01, 0]], np.full((2, 3, 3), np.nan),
        np.zeros(2), [2, 2], [0, 0], ("1", "2"),
    )  # fmt: skip
    assert judged(positions, truth).not_measured == ()


@pytest.mark.parametrize(("flagged", "hollow"), [(135, False), (136, True)])
def test_control_points_of_which_most_are_flagged(flagged, hollow):
    positions, truth = readings(flagged=flagged)
    check = compare_with_control(positions, truth)
    assert bool(check.hollow) is hollow


def bar(flags, *, measured=True):
    ends = np.array([[0.0, 0, 0], [5, 0, 0]] * 2)
    if not measured:
        ends[3] = np.nan
    return Positions(
        ("s0", "s0", "s1", "s1"), ("a", "b") * 2, ends, np.full((4, 3, 3), np.nan),
        np.zeros(4), [2] * 4, flags, ("",) * 4,
    )  # fmt: skip


def test_a_length_that_one_placement_lists_but_does_not_measure_is_missing():
    positions = bar([0, 0, 0, int(Flag.single_view)], measured=False)
    with pytest.warns(CloseRangeWarning, match="1 of 2 lengths were not measured"):
        check = length_test(positions, Lengths.of("a", "b", [5.0]))
    assert check.missing == (("s1", "a", "b"),)
    found = sentence(check)
    assert found.text.endswith("; but 1 of 2 lengths were not measured.")
    assert found.tone == "warn"


def test_lengths_of_which_most_are_flagged_say_nothing():
    with pytest.warns(CloseRangeWarning, match="2 of 2 lengths have a flagged end"):
        check = length_test(bar([0, BAD, BAD, 0]), Lengths.of("a", "b", [5.0]))
    assert check.hollow.startswith("2 of 2 lengths could not be used")


@pytest.mark.parametrize(("confidence", "guard"), [(0.5, 0.0), (0.95, 1.6449), (0.99, 2.3263)])
def test_the_confidence_sets_the_guard_band(confidence, guard):
    positions, truth = readings()
    limits = Limits.of(accuracy_mm=0.05, confidence=confidence)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        report = single_point_test(positions, truth, limits=limits, gauge_std_mm=0.01)
    assert report.judgements[0].guard == pytest.approx(0.01 * guard, abs=1e-5)


@pytest.mark.parametrize("confidence", [0.49, 1.0, float("nan")])
def test_impossible_confidence(confidence):
    with pytest.raises(InputError, match="confidence"):
        Limits.of(accuracy_mm=1.0, confidence=confidence)


def test_the_table_gives_the_same_region_as_the_positions(tmp_path):
    """With 4 degrees of freedom the region is 2.5 times as large as with a known variance."""
    positions, truth = readings(dof=4, seed=3)
    positions.to_csv(tmp_path / "p.csv")
    tables = (positions, read_positions(tmp_path / "p.csv"), readings(seed=3)[0])
    here, there, other = (judged(rows, truth).coverage for rows in tables)
    assert (here.inside, here.count) == (there.inside, there.count)
    assert here.inside > other.inside or other.inside == other.count
    control = [compare_with_control(rows, truth).coverage["all"].inside for rows in tables]
    assert control[0] == control[1] > control[2]
