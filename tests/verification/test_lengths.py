"""Lengths: reader, errors, prediction."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import DataError, TableError
from closerange.flags import Flag
from closerange.position.positions import Positions
from closerange.verification.lengths import Lengths, length_test, read_lengths


def bars(ends, *, cov=None, flags=0):
    """Make positions of points a, b in each placement from (placements, 2, 3)."""
    ends = np.asarray(ends, float)
    rows = 2 * len(ends)
    return Positions(
        placement=tuple(f"s{i}" for i in range(len(ends)) for _ in "ab"),
        point=("a", "b") * len(ends),
        xyz_mm=ends.reshape(-1, 3),
        cov_mm2=np.broadcast_to(np.full((3, 3), np.nan) if cov is None else cov, (rows, 3, 3)),
        residual_px=np.full(rows, np.nan),
        cameras=np.full(rows, 2),
        flags=np.broadcast_to(flags, (rows,)),
        reading=("",) * rows,
    )


def test_errors_are_measured_minus_true_in_every_placement():
    check = length_test(
        bars([[[0, 0, 0], [3, 4, 0]], [[1, 1, 1], [1, 1, 5.9]]]), Lengths.of("a", "b", [5.0])
    )
    assert check.placement == ("s0", "s1")
    assert check.error_mm == pytest.approx([0.0, -0.1])
    assert check.rms_mm == pytest.approx(np.sqrt(0.005))
    assert check.max_mm == pytest.approx(0.1)
    assert np.isnan(check.predicted_std_mm).all()
    assert np.isnan(check.ratio)
    assert "2 lengths" in str(check)


def test_prediction_takes_the_covariance_along_the_line():
    cov = np.diag([0.01, 0.04, 0.09])
    check = length_test(
        bars([[[0, 0, 0], [0, 0, 5]]], cov=cov), Lengths.of("a", "b", [4.0], std_mm=0.1)
    )
    assert check.predicted_std_mm == pytest.approx([np.sqrt(0.09 + 0.09 + 0.01)])
    assert check.ratio == pytest.approx(1 / np.sqrt(0.19))


def test_prediction_holds_for_independent_ends():
    rng = np.random.default_rng(0)
    ends = rng.uniform(-50, 50, (2000, 2, 3))
    true = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    std = np.array([0.01, 0.01, 0.03])
    positions = bars(ends + std * rng.standard_normal(ends.shape), cov=np.diag(std**2))
    placements = [f"s{i}" for i in range(2000)]
    truth = Lengths.of(["a"] * 2000, ["b"] * 2000, true, placement=placements)
    assert length_test(positions, truth).ratio == pytest.approx(1.0, abs=0.05)


def test_flagged_ends_are_listed_and_not_averaged():
    flags = [0, 0, int(Flag.residual), 0]
    with pytest.warns(UserWarning, match="1 of 2 lengths have a flagged end"):
        check = length_test(
            bars([[[0, 0, 0], [5.1, 0, 0]], [[0, 0, 0], [90, 0, 0]]], flags=flags),
            Lengths.of("a", "b", [5.0]),
        )
    assert check.reservations == ("1 of 2 lengths have a flagged end and were left out",)
    assert check.hollow == ""  # half of them count
    assert check.used.tolist() == [True, False]
    assert check.max_mm == pytest.approx(0.1)
    assert check.to_document()["rows"]["flags"] == ["", "residual"]


def test_unmeasured_lengths_are_listed():
    positions = bars([[[0, 0, 0], [5, 0, 0]]])
    with pytest.warns(UserWarning, match="1 of 2 lengths were not measured"):
        check = length_test(positions, Lengths.of(["a", "a"], ["b", "c"], [5.0, 7.0]))
    assert check.missing == (("", "a", "c"),)
    assert check.to_document()["reservations"] == ["1 of 2 lengths were not measured"]
    with pytest.raises(DataError, match="none of 1 lengths"):
        length_test(positions, Lengths.of(["x"], ["y"], [1.0]))


def test_reader_takes_columns_by_name(tmp_path):
    path = tmp_path / "lengths.csv"
    path.write_text("length_mm,point_b,point_a,std_mm\n100.5,b,01,0.002\n50,c,b,\n")
    truth = read_lengths(path)
    assert truth.point_a == ("01", "b")
    assert truth.placement == ("", "")
    assert truth.length_mm.tolist() == [100.5, 50.0]
    assert truth.std_mm.tolist() == [0.002, 0.0]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a,a,5,", "both ends are point 'a'"),
        ("a,b,0,", "length exceeds 0"),
        ("a,b,5,-1", "not negative"),
        ("a,b,,", "empty"),
    ],
)
def test_reader_names_the_bad_cell(tmp_path, row, message):
    path = tmp_path / "lengths.csv"
    path.write_text(f"point_a,point_b,length_mm,std_mm\n{row}\n")
    with pytest.raises(TableError, match=message) as caught:
        read_lengths(path)
    assert "row 2" in str(caught.value)
