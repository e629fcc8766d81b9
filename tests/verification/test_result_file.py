"""Stored results: strict JSON that round-trips."""

from __future__ import annotations

import json

import numpy as np
import pytest

from closerange.errors import SchemaError
from closerange.features.control import ControlPoints
from closerange.position.positions import Positions
from closerange.verification.control_check import compare_with_control
from closerange.verification.judgement import Limits
from closerange.verification.lengths import Lengths, length_test
from closerange.verification.result_file import plain, read_result, write_result
from closerange.verification.single_point import single_point_test


@pytest.fixture(scope="module")
def results():
    """One result of each kind."""
    rng = np.random.default_rng(0)
    truth = ControlPoints.of([f"p{i}" for i in range(5)], rng.uniform(0, 9, (5, 3)))
    positions = Positions(
        placement=("",) * 15,
        point=truth.point * 3,
        xyz_mm=np.tile(truth.xyz_mm, (3, 1)) + 0.01 * rng.standard_normal((15, 3)),
        cov_mm2=np.broadcast_to(1e-4 * np.eye(3), (15, 3, 3)),
        residual_px=np.full(15, np.nan),
        cameras=np.full(15, 2),
        flags=np.zeros(15, int),
        reading=tuple("123"[i // 5] for i in range(15)),
    )
    length = float(np.linalg.norm(truth.xyz_mm[0] - truth.xyz_mm[1]))
    return {
        "control": compare_with_control(positions, truth),
        "single-point": single_point_test(positions, truth, limits=Limits.of(accuracy_mm=0.1)),
        "lengths": length_test(positions, Lengths.of(["p0"], ["p1"], [length])),
    }


@pytest.mark.parametrize("kind", ["control", "single-point", "lengths"])
def test_every_kind_round_trips_exactly(results, kind, tmp_path):
    path, again = tmp_path / "a.json", tmp_path / "b.json"
    write_result(results[kind], path, provenance={"version": "1"})
    document = read_result(path)
    assert document["schema"] == "closerange.result/1"
    assert document["kind"] == kind
    assert document["provenance"] == {"version": "1"}
    assert document == {
        "schema": "closerange.result/1",
        **results[kind].to_document(),
        "provenance": {"version": "1"},
    }
    write_result(results[kind], again, provenance={"version": "1"})
    assert path.read_bytes() == again.read_bytes()


def test_rows_of_a_document_have_equal_lengths(results):
    for result in results.values():
        rows = result.to_document()["rows"]
        assert len({len(column) for column in rows.values()}) == 1
        assert len(rows["flags"]) == len(result)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ([1], "schema is 'list'"),
        ({"schema": "closerange.rig/1"}, "expected 'closerange.result/1'"),
        ({"schema": "closerange.result/1", "kind": "x"}, "known kinds are control"),
        ({"schema": "closerange.result/1", "kind": []}, "known kinds are control"),
        ({"schema": "closerange.result/1", "kind": "lengths"}, "rows, rms_mm.* missing"),
    ],
)
def test_other_files_are_refused(tmp_path, document, message):
    path = tmp_path / "x.json"
    path.write_text(json.dumps(document))
    with pytest.raises(SchemaError, match=message):
        read_result(path)


def test_unknown_numbers_become_null():
    assert plain({"a": np.array([1.0, np.nan]), 2: (np.float64(np.inf), np.bool_(True), 3)}) == {
        "a": [1.0, None],
        "2": [None, True, 3],
    }
