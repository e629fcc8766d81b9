"""Heights of known parts: which points count for which top, and what is said of them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from closerange.errors import CloseRangeWarning, DataError
from closerange.flags import Flag
from closerange.position.positions import Positions
from closerange.verification.heights import FEWEST, height_test
from closerange.verification.known_parts import Parts
from closerange.verification.result_file import read_result, write_result

PARTS = Parts.of(
    ["tall", "round"], ["box", "disc"], [[0, 0, 30], [60, 0, 10]], [[20, 20], [20, 20]],
    height_mm=[50, 30],
)  # fmt: skip


def positions(xyz_mm, *, std_mm=0.02, flags=None, placement=""):
    count = len(xyz_mm)
    return Positions(
        placement=(placement,) * count,
        point=tuple(f"e{i}" for i in range(count)),
        xyz_mm=xyz_mm,
        cov_mm2=np.broadcast_to(np.eye(3) * std_mm**2, (count, 3, 3)),
        residual_px=np.zeros(count),
        cameras=np.full(count, 2),
        flags=np.zeros(count, int) if flags is None else flags,
        reading=("",) * count,
    )


def outlines(shift_mm=0.0):
    """Return 20 points on each outline, and the feet of the box's sides below them."""
    at = np.linspace(-9, 9, 20)
    box = np.column_stack([at, np.full(20, 10.0), np.full(20, 30.0 + shift_mm)])
    turn = np.linspace(0, 6, 20)
    disc = np.column_stack([60 + 10 * np.cos(turn), 10 * np.sin(turn), np.full(20, 10.0)])
    foot = box * (1, 1, 0) + (0, 0, -20)
    return np.concatenate([box, disc, foot])


def test_points_on_outlines_give_medians():
    xyz = outlines(0.03)
    xyz[3, 2] += 0.5
    check = height_test(positions(xyz), PARTS)
    assert check.part == ("tall", "round")
    assert check.place == ("outline", "outline")
    assert check.count.tolist() == [20, 20]
    np.testing.assert_allclose(check.measured_mm, [50.03, 30], atol=1e-12)
    np.testing.assert_allclose(check.error_mm, [0.03, 0], atol=1e-12)
    np.testing.assert_allclose(check.worst_mm, [0.53, 0], atol=1e-12)
    np.testing.assert_allclose(check.std_mm, [np.std(xyz[:20, 2], ddof=1), 0], atol=1e-12)
    np.testing.assert_allclose(check.predicted_std_mm, 0.02)
    assert (check.elsewhere, check.flagged) == (20, 0)  # the feet of the sides
    assert check.max_mm == pytest.approx(0.03)
    assert check.rms_mm == pytest.approx(np.sqrt(0.03**2 / 2))
    assert check.points_median_mm == pytest.approx(0.015)
    assert check.hollow == ""


def test_a_middle_counts_by_itself():
    check = height_test(positions([[0.2, -0.3, 29.9], [60.1, 0, 10.2]]), PARTS)
    assert check.place == ("middle", "middle")
    np.testing.assert_allclose(check.error_mm, [-0.1, 0.2], atol=1e-12)
    assert check.used.all()
    assert np.isnan(check.std_mm).all()


def test_flagged_points_are_left_out_and_tolerated_ones_are_not():
    flags = np.zeros(60, int)
    flags[0], flags[1], flags[20] = Flag.ambiguous, Flag.outside_volume, Flag.untrusted
    xyz = outlines()
    xyz[0, 2] += 1
    check = height_test(positions(xyz, flags=flags), PARTS)
    assert check.count.tolist() == [19, 20]
    assert check.flagged == 1
    assert check.points_max_mm < 1e-12


def test_an_uncertain_point_may_lie_farther_away():
    xyz = outlines()
    xyz[:20, 1] += 1.5
    with pytest.warns(CloseRangeWarning, match="tall"):
        near = height_test(positions(xyz), PARTS)
    assert near.missing == (("", "tall"),)
    far = height_test(positions(xyz, std_mm=0.5), PARTS)
    assert far.count.tolist() == [20, 20]
    assert height_test(positions(xyz), PARTS, tolerance_mm=2).count.tolist() == [20, 20]


def test_a_point_between_two_tops_counts_for_the_nearer():
    near = Parts.of(
        ["a", "b"], ["box", "box"], [[0, 0, 30], [20.4, 0, 30]], [[20, 20], [20, 20]], height_mm=30
    )
    xyz = np.array([[10.1, y, 30.0] for y in range(-5, 5)] + [[10.4, y, 30] for y in range(-5, 5)])
    assert height_test(positions(xyz), near).count.tolist() == [10, 10]


def test_too_few_points_are_listed_and_not_averaged():
    xyz = outlines(1.0)[[*range(FEWEST - 1), *range(20, 40)]]
    with pytest.warns(CloseRangeWarning, match=r"1 of 2 parts \(tall\) have fewer than 5"):
        check = height_test(positions(xyz), PARTS)
    assert check.used.tolist() == [False, True]
    assert check.max_mm < 1e-12
    assert check.missing == (("", "tall"),)
    assert "parts could not be used" not in check.hollow  # one of two is not most


def test_most_parts_missing_prove_nothing():
    three = Parts.of(
        ["a", "b", "c"], ["disc"] * 3, [[0, 0, 30], [90, 0, 9], [60, 0, 10]],
        [[9, 9], [9, 9], [20, 20]], height_mm=30,
    )  # fmt: skip
    with pytest.warns(CloseRangeWarning, match="2 of 3 parts"):
        check = height_test(positions(outlines()[20:40]), three)
    assert check.hollow.startswith("2 of 3 parts could not be used")


def test_points_of_another_scene_are_refused():
    with pytest.raises(DataError, match="none of 60 usable positions lies on a top"):
        height_test(positions(outlines() + np.array([500, 0, 0])), PARTS)


def test_a_part_holds_in_its_placement_only():
    parts = Parts.of(
        ["a", "a"], ["disc", "disc"], [[60, 0, 10], [60, 0, 12]], [[20, 20]] * 2,
        height_mm=30, placement=["one", "two"],
    )  # fmt: skip
    with pytest.warns(CloseRangeWarning, match="1 of 2 parts"):
        check = height_test(positions(outlines()[20:40], placement="one"), parts)
    assert check.placement == ("one",)
    np.testing.assert_allclose(check.error_mm, 0, atol=1e-12)
    assert check.missing == (("two", "a"),)


def test_a_world_whose_z_points_down():
    parts = Parts.of(["a"], ["disc"], [[60, 0, -10]], [[20, 20]], height_mm=-30)
    xyz = outlines()[20:40] * (1, 1, -1) - (0, 0, 0.1)
    check = height_test(positions(xyz), parts)
    np.testing.assert_allclose(check.measured_mm, -30.1)


def test_the_result_can_be_stored(tmp_path):
    check = height_test(positions(outlines(0.03)), PARTS)
    write_result(check, tmp_path / "r.json")
    document = read_result(tmp_path / "r.json")
    assert document["kind"] == "heights"
    assert document["rows"]["part"] == ["tall", "round"]
    assert document["max_mm"] == pytest.approx(0.03)
    assert "NaN" not in json.dumps(document)
    assert str(check).startswith("heights of 2 parts: rms error 21.2 um")
