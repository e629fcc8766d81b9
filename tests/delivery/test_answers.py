import dataclasses

import numpy as np
import pytest

from closerange.delivery.answers import answers
from closerange.delivery.sheet import Contents
from closerange.flags import Flag

QUESTIONS = [
    "What was measured",
    "How accurate",
    "May it be believed",
    "Why",
    "Why not",
    "Mind that",
]


def _answers(**known):
    checks = tuple(check.to_document() for check in known.pop("checks", ()))
    found = answers(Contents(title="t", checks=checks, **known))
    return dict(found.entries)


def _trusted(rig, verdict):
    trust = dataclasses.replace(rig.trust, verdict=verdict, reasons=())
    return dataclasses.replace(rig, trust=trust)


@pytest.fixture
def clean(positions):
    """The same readings without a flag."""
    return dataclasses.replace(positions, flags=np.zeros(len(positions), int))


def test_questions_come_in_the_order_of_a_reader(rig, acceptance, positions):
    found = _answers(rig=rig, checks=[acceptance], positions={"": positions})
    assert list(found) == QUESTIONS
    assert "12 known positions, 4 readings at each" in found["What was measured"]
    assert "2 cameras calibrated from 52 image points" in found["What was measured"]
    assert "80 × 80 × 80 mm" in found["What was measured"]  # noqa: RUF001
    rms = 1000 * acceptance.accuracy.rms_mm[0]
    assert f"Error of a position, mean of its readings: {rms:.1f} µm (X)" in found["How accurate"]


def test_a_good_calibration_that_agrees_with_its_test_is_believed(rig, acceptance, clean):
    found = _answers(rig=_trusted(rig, "good"), checks=[acceptance], positions={"": clean})
    assert found["May it be believed"] == "Yes."
    assert "The calibration is good." in found["Why"]
    assert "12 of 12 errors (100.0 %) lie inside their stated 95 % region" in found["Why"]
    assert "No flag on any of 25 measured positions." in found["Why"]
    assert "Why not" not in found


def test_without_a_comparison_it_is_a_prediction(rig):
    found = _answers(rig=_trusted(rig, "good"))
    assert found["May it be believed"].startswith("As a prediction")
    assert found["How accurate"].startswith("Predicted standard deviation 4.1 µm (X)")


@pytest.mark.parametrize(("verdict", "word"), [("fair", "With res"), ("untrustworthy", "No.")])
def test_a_bad_calibration_is_a_reason_against(rig, acceptance, verdict, word):
    found = _answers(rig=_trusted(rig, verdict), checks=[acceptance])
    assert found["May it be believed"].startswith(word)
    assert f"The calibration is {verdict}." in found["Why not"]


def test_flags_are_a_reason_against(rig, acceptance, positions):
    found = _answers(rig=_trusted(rig, "good"), checks=[acceptance], positions={"": positions})
    assert found["May it be believed"] == "With reservations."
    assert "2 of 25 measured positions carry a flag" in found["Why not"]


def test_uncertainties_that_are_too_small_are_a_reason_against(acceptance):
    document = acceptance.to_document()
    small = {"count": 12, "inside": 3, "share": 0.25, "low": 0.1, "high": 0.5, "mean_ratio": 9.0}
    checks = ({**document, "coverage": {"level": 0.95, **small}},)
    found = dict(answers(Contents(title="t", checks=checks)).entries)
    assert "too small: only 3 of 12 errors (25.0 %)" in found["Why not"]
    less = {**small, "mean_ratio": 1.5}  # one calibration's luck
    checks = ({**document, "coverage": {"level": 0.95, **less}},)
    found = dict(answers(Contents(title="t", checks=checks)).entries)
    assert "Why not" not in found
    assert "somewhat few" in found["Mind that"]


def test_fitted_control_points_prove_nothing(control_check):
    document = control_check.to_document()
    document["groups"]["check"] = {**document["groups"]["check"], "count": 0}
    found = dict(answers(Contents(title="t", checks=(document,))).entries)
    assert "fitted ones fit too well" in found["Why not"]


@pytest.mark.parametrize(("error", "judged"), [(2.5, "Why"), (2.6, "Why not")])
def test_a_length_is_judged_by_what_chance_explains(length_check, error, judged):
    """One length: 1 % of normal errors are beyond 2.576 standard deviations."""
    document = {**length_check.to_document(), "missing": []}
    std = document["rows"]["predicted_std_mm"]
    rows = {**document["rows"], "error_mm": [error * value for value in std]}
    found = dict(answers(Contents(title="t", checks=({**document, "rows": rows},))).entries)
    assert f"{error:.1f} predicted standard deviations" in found[judged]


def test_what_was_not_measured_is_said(length_check):
    found = _answers(checks=[length_check])
    assert "1 of 2 lengths were not measured." in found["Why not"]


def test_counts_are_those_of_all_jobs(positions, points):
    assert (
        "50 positions" in _answers(positions={"a": positions, "b": positions})["What was measured"]
    )
    assert _answers(points={"": points}) == {"What was measured": "54 image points."}
    assert np.any(positions.flags & int(Flag.residual))


def test_nothing_known_asks_nothing():
    assert answers(Contents(title="t")) is None
