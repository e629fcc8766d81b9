"""Comparison with control points: the thesis' tables, groups, repeated errors."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from closerange.errors import DataError
from closerange.features.control import ControlPoints
from closerange.flags import Flag
from closerange.position.positions import Positions
from closerange.verification.control_check import compare_with_control

TABLES = {18: "fig_2_5_2_6_n18.csv", 27: "fig_2_7_2_8_n27.csv", 54: "fig_2_9_2_10_n54.csv"}


def positions_of(xyz, *, placement=None, point=None, flags=None, cov=np.nan):
    xyz = np.asarray(xyz, float)
    count = len(xyz)
    return Positions(
        placement=placement or ("",) * count,
        point=point or tuple(f"p{i}" for i in range(count)),
        xyz_mm=xyz,
        cov_mm2=np.broadcast_to(cov * np.eye(3), (count, 3, 3)),
        residual_px=np.full(count, np.nan),
        cameras=np.full(count, 2),
        flags=np.zeros(count, int) if flags is None else flags,
        reading=("",) * count,
    )


def thesis_table(shared, count, *, restore=False):
    """Read a table of chapter 2; the placement is the run and row, the point the dot's place.

    Cells of which only the magnitude of the error survives are lost, or restored with an error
    of unknown, here positive, sign: that leaves averages of absolute errors what they were.
    """
    with (shared / "data/thesis" / TABLES[count]).open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    original = np.array([[float(row[name]) for name in ("Xo", "Yo", "Zo")] for row in rows])
    calculated = np.array([[float(row[n] or "nan") for n in ("X", "Y", "Z")] for row in rows])
    if restore:
        size = np.array([[float(row[n] or "nan") for n in ("eX", "eY", "eZ")] for row in rows])
        calculated = np.where(np.isnan(calculated), original + size, calculated)
    placement = tuple(f"{count}-{row['row']}" for row in rows)
    point = tuple(f"{row['Xo']}/{row['Yo']}" for row in rows)
    role = [row["role"] for row in rows]
    control = ControlPoints.of(
        point, original, placement=placement, check=[name == "check" for name in role]
    )
    flags = np.where(np.isfinite(calculated).all(axis=1), 0, int(Flag.not_found))
    return positions_of(calculated, placement=placement, point=point, flags=flags), control


@pytest.mark.parametrize("count", [18, 27])
def test_averages_of_the_thesis_are_recomputed(shared, count):
    check = compare_with_control(*thesis_table(shared, count, restore=True))
    known = json.loads((shared / "data/thesis/averages_check.json").read_text())[str(count)]
    for axis, name in enumerate("XYZP"):
        # printed to five digits from errors that were rounded to five digits
        printed = known[name]["printed"]
        assert check.groups["all"].mean_abs_mm[axis] == pytest.approx(printed, abs=1.6e-5)
        for role, field in (("fitted", "calibration_rows"), ("check", "check_rows")):
            found = check.groups[role].mean_abs_mm[axis]
            assert found == pytest.approx(known[name][field], abs=1e-5)
        assert check.groups["all"].max_mm[axis] == pytest.approx(known[name]["max_all"], abs=2e-5)
        rms = check.groups["fitted"].rms_mm[axis]
        assert rms == pytest.approx(known[name]["rms_cal"], abs=1e-5)
    assert check.groups["all"].count == known["X"]["n_all"]


def test_partly_lost_rows_of_the_54_point_run_are_listed_and_left_out(shared):
    positions, control = thesis_table(shared, 54)
    check = compare_with_control(positions, control)
    lost = int((~positions.measured).sum())
    assert lost > 0
    assert len(check.left_out) == lost
    assert {row[3] for row in check.left_out} == {"not_found"}
    assert check.groups["all"].count == 64 - lost
    error = (positions.xyz_mm - control.xyz_mm)[positions.measured]
    assert check.groups["all"].mean_abs_mm[:3] == pytest.approx(np.abs(error).mean(axis=0))


def test_most_of_the_x_error_of_the_thesis_repeats_per_dot(shared):
    """Report: 89 % of X and 73 % of Y variance; X rms 0.051 to 0.017, Y 0.021 to 0.011."""
    tables = [thesis_table(shared, count) for count in TABLES]
    parts = [positions.select(~control.check) for positions, control in tables]
    merged = Positions(
        placement=sum((part.placement for part in parts), ()),
        point=sum((part.point for part in parts), ()),
        xyz_mm=np.concatenate([part.xyz_mm for part in parts]),
        cov_mm2=np.concatenate([part.cov_mm2 for part in parts]),
        residual_px=np.concatenate([part.residual_px for part in parts]),
        cameras=np.concatenate([part.cameras for part in parts]),
        flags=np.concatenate([part.flags for part in parts]),
        reading=sum((part.reading for part in parts), ()),
    )
    control = ControlPoints.of(
        sum((c.point for _, c in tables), ()),
        np.concatenate([c.xyz_mm for _, c in tables]),
        placement=sum((c.placement for _, c in tables), ()),
    )
    systematic = compare_with_control(merged, control).systematic
    assert len(systematic.point) == 9
    assert systematic.repeated_share[:2] == pytest.approx([0.89, 0.73], abs=0.02)
    assert systematic.rms_mm[:2] == pytest.approx([0.051, 0.021], abs=0.001)
    assert systematic.rms_without_mm[:2] == pytest.approx([0.017, 0.011], abs=0.001)
    assert systematic.chance_share < 0.12
    centre = systematic.point.index("0.00000/0.00000")
    assert systematic.mean_mm[centre, 0] == pytest.approx(0.1024, abs=2e-3)
    assert systematic.std_mm[centre, 0] == pytest.approx(0.0209, abs=2e-3)


def test_groups_keep_fitted_check_inside_and_outside_apart():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [0, 1, 0]])
    error = np.array([[0.1, 0, 0], [0.2, 0, 0], [0.9, 0, 0], [0.4, 0, 0]])
    positions = positions_of(truth + error, cov=0.01)
    control = ControlPoints.of(positions.point, truth)
    check = compare_with_control(
        positions, control, fitted={("", "p0"), ("", "p1")}, volume_mm=[[0, 0, 0], [1, 1, 0]]
    )
    assert check.role == ("fitted", "fitted", "check", "check")
    found = {name: (g.count, float(g.mean_abs_mm[0])) for name, g in check.groups.items()}
    assert found["fitted"] == pytest.approx((2, 0.15))
    assert found["check"] == pytest.approx((2, 0.65))
    assert found["inside"] == pytest.approx((3, 0.7 / 3))
    assert found["outside"] == pytest.approx((1, 0.9))
    assert found["all"] == pytest.approx((4, 0.4))
    # errors of 4 and 9 standard deviations lie outside of the 95 % region (2.80), 1 and 2 inside
    assert check.coverage["all"].inside == 2
    assert "check (2)" in str(check)


def test_flagged_rows_are_listed_and_change_no_average():
    truth = np.zeros((4, 3))
    xyz = np.array([[0.1, 0, 0], [50, 0, 0], [0.3, 0, 0], [np.nan] * 3])
    flags = [0, int(Flag.residual), int(Flag.outside_volume), int(Flag.single_view)]
    positions = positions_of(xyz, flags=flags)
    check = compare_with_control(positions, ControlPoints.of(positions.point, truth))
    assert check.used.tolist() == [True, False, True, False]
    assert check.groups["all"].mean_abs_mm[0] == pytest.approx(0.2)
    assert check.left_out == (("", "", "p1", "residual"), ("", "", "p3", "single_view"))
    assert len(check) == 4
    assert check.not_measured == (("", "p3"),)
    assert set(check.groups) == {"all"}


def test_positions_without_a_truth_are_listed():
    positions = positions_of(np.zeros((2, 3)))
    check = compare_with_control(positions, ControlPoints.of(["p1"], np.zeros((1, 3))))
    assert check.missing == (("", "", "p0"),)
    assert check.point == ("p1",)


def test_no_common_name_is_refused():
    with pytest.raises(DataError, match="none of 1 positions is among the 1"):
        compare_with_control(
            positions_of(np.zeros((1, 3))), ControlPoints.of(["x"], np.zeros((1, 3)))
        )


def test_uncertain_control_widens_the_regions():
    positions = positions_of([[0.5, 0, 0]], cov=0.01)
    exact, uncertain = (
        compare_with_control(positions, ControlPoints.of(["p0"], np.zeros((1, 3)), std_mm=std))
        for std in (0.0, 0.3)
    )
    assert exact.coverage["all"].inside == 0
    assert uncertain.coverage["all"].inside == 1
    assert uncertain.coverage["all"].mean_ratio == pytest.approx(0.25 / (0.01 + 0.09) / 3)
