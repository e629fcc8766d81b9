"""The verbs `verify` and `report`, called from Python."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import (
    DataError,
    InputError,
    SchemaError,
)
from closerange.features.control import ControlPoints, write_control
from closerange.position.positions import Positions
from closerange.verification.acceptance import AcceptanceReport
from closerange.verification.control_check import ControlCheck
from closerange.verification.judgement import Limits
from closerange.verification.lengths import LengthCheck, Lengths
from closerange.verification.result_file import write_result
from closerange.workflows.report import report
from closerange.workflows.verify import verify


def truth_and_positions():
    """Two points, three readings each, errors known."""
    truth = ControlPoints.of(["a", "b"], [[0.0, 0, 0], [30, 40, 0]])
    offsets = np.array([[0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0]])
    xyz = np.concatenate([truth.xyz_mm[0] + offsets, truth.xyz_mm[1] + offsets])
    positions = Positions(
        placement=("",) * 6, point=("a",) * 3 + ("b",) * 3, xyz_mm=xyz,
        cov_mm2=np.tile(np.eye(3) * 1e-4, (6, 1, 1)), residual_px=np.zeros(6),
        cameras=np.full(6, 2), flags=np.zeros(6, int), reading=("0", "1", "2") * 2,
    )  # fmt: skip
    return truth, positions


def test_the_three_kinds_of_verification():
    truth, positions = truth_and_positions()
    control = verify("control", positions, truth=truth)
    assert isinstance(control, ControlCheck)
    single = verify(
        "single-point", positions, truth=truth, cycle_time_s=1.5,
        limits=Limits.of(accuracy_mm=(0.05, 0.05, 0.05), repeatability_mm=None),
    )  # fmt: skip
    assert isinstance(single, AcceptanceReport)
    assert single.accuracy.max_mm[0] == pytest.approx(0.02)  # of the mean of three readings
    assert single.repeatability.pooled.std_mm[0] == pytest.approx(0.01)
    lengths = verify("lengths", positions, truth=Lengths.of(["a"], ["b"], [50.0]))
    assert isinstance(lengths, LengthCheck)
    assert lengths.used.sum() == 3
    assert lengths.max_mm == pytest.approx(0, abs=1e-12)  # both ends err alike


def test_verify_reads_files(tmp_path):
    truth, positions = truth_and_positions()
    positions.to_csv(tmp_path / "positions.csv")
    write_control(truth, tmp_path / "truth.csv")
    (tmp_path / "lengths.csv").write_text("point_a,point_b,length_mm\na,b,49.9\n", encoding="utf-8")
    result = verify("single-point", tmp_path / "positions.csv", truth=tmp_path / "truth.csv")
    assert result.accuracy.max_mm[0] == pytest.approx(0.02)
    result = verify("lengths", tmp_path / "positions.csv", truth=tmp_path / "lengths.csv")
    assert result.bias_mm == pytest.approx(0.1)


def test_verification_refuses_what_does_not_fit():
    truth, positions = truth_and_positions()
    with pytest.raises(InputError, match="beauty") as caught:
        verify("beauty", positions, truth=truth)
    assert "control, single-point, lengths" in caught.value.remedy
    with pytest.raises(InputError, match="true positions given"):
        verify("lengths", positions, truth=truth)
    with pytest.raises(InputError, match="true lengths given"):
        verify("control", positions, truth=Lengths.of(["a"], ["b"], [50.0]))
    with pytest.raises(DataError):
        verify("control", positions, truth=ControlPoints.of(["c"], [[0.0, 0, 0]]))


def test_report_refuses_what_is_no_stored_result(tmp_path):
    path = tmp_path / "other.json"
    for text in ('{"schema": "closerange.soup/1"}', "[]", "{}"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(SchemaError, match="no stored result"):
            report(path)
    path.write_text('{"schema": "closerange.run/1", "title": "half"}', encoding="utf-8")
    with pytest.raises(SchemaError, match="not a complete run"):
        report(path)


def test_report_of_each_kind_of_result(tmp_path):
    truth, positions = truth_and_positions()
    for kind, known, title in (
        ("control", truth, "Comparison with control points"),
        ("single-point", truth, "Single-point test"),
        ("lengths", Lengths.of(["a"], ["b"], [50.0]), "Length test"),
    ):
        path = tmp_path / f"{kind}.json"
        write_result(verify(kind, positions, truth=known), path)
        assert f"<title>{title}" in report(path)
