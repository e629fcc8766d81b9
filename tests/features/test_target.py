"""Targets: layout, limits, placement in the world."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from closerange.errors import InputError, SchemaError
from closerange.features.target import Charuco, Chessboard, DiscGrid, Target, control_at
from closerange.geometry.transform import RigidTransform, rotation_from_vector

MARKS = ((6, 3, 8.0), (6, 8, 8.0), (2, 3, 8.0))


def test_layout_follows_the_published_formula():
    target = Target.of(DiscGrid(3, 4, (45.0, 30.0), 16.0), std_mm=0.02)
    for name, xyz in zip(target.point, target.xyz_mm, strict=True):
        row, column = (int(part) for part in name[1:].split("c"))
        assert xyz.tolist() == [(column - 1.5) * 45.0, (1 - row) * 30.0, 0.0]
    assert target.point[:5] == ("r0c0", "r0c1", "r0c2", "r0c3", "r1c0")
    assert target.std_mm.tolist() == [0.02] * 12
    assert not target.xyz_mm.flags.writeable


def test_plate_at_height_gives_the_rendered_world_positions(shared):
    path = shared / "data" / "rendered" / "A_calib_discs" / "targets.csv"
    with path.open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["image"] == "left_z+16.7.png"]
    height = float(rows[0]["Z_mm"])
    control = control_at(Target.of(DiscGrid(3, 3, (45.0, 45.0), 16.0)), z_mm=height, placement="a")
    truth = [[float(row[key]) for key in ("X_mm", "Y_mm", "Z_mm")] for row in rows]
    assert np.abs(control.xyz_mm - truth).max() < 1e-6
    assert set(control.placement) == {"a"}


def test_charuco_points_are_inner_corners():
    target = Target.of(Charuco(4, 5, 54.0, 40.0, "DICT_4X4_50"))
    assert len(target) == 12
    assert target.point[-1] == "r2c3"
    assert target.xyz_mm[0].tolist() == [-81.0, 54.0, 0.0]
    assert np.isnan(target.diameters_mm).all()


def test_marks_have_their_own_diameters_and_choose_the_default_orientation():
    grid = DiscGrid(9, 12, (10, 10), 5.8, "dark-on-white", mark_discs=MARKS)
    assert grid.orientation == "marks"
    assert DiscGrid(3, 3, (45, 45), 16).orientation == "upright"
    diameters = Target.of(grid).diameters_mm.reshape(9, 12)
    assert [diameters[6, 3], diameters[6, 8], diameters[2, 3]] == [8.0] * 3
    assert np.count_nonzero(diameters == 5.8) == 105


@pytest.mark.parametrize(
    ("build", "key"),
    [
        (lambda: DiscGrid(0, 3, (45, 45), 16), "rows"),
        (lambda: DiscGrid(200, 200, (45, 45), 16), "rows"),
        (lambda: DiscGrid(3, 3, (45, -45), 16), "pitch_mm"),
        (lambda: DiscGrid(3, 3, (45, 45, 45), 16), "pitch_mm"),
        (lambda: DiscGrid(3, 3, (45, 45), float("nan")), "disc_diameter_mm"),
        (lambda: DiscGrid(3, 3, (45, 16), 16), "disc_diameter_mm"),
        (lambda: DiscGrid(3, 3, (45, 45), 16, "black"), "polarity"),
        (lambda: DiscGrid(3, 3, (45, 45), 16, orientation="any"), "orientation"),
        (lambda: DiscGrid(3, 3, (45, 45), 16, orientation="marks"), "orientation"),
        (lambda: DiscGrid(3, 4, (45, 45), 16, mark_discs=((3, 0, 20),)), "mark_discs"),
        (lambda: DiscGrid(3, 4, (45, 45), 16, mark_discs=((0, -1, 20),)), "mark_discs"),
        (lambda: DiscGrid(3, 4, (45, 45), 16, mark_discs=((0, 0, 16),)), "mark_discs"),
        (lambda: DiscGrid(3, 4, (45, 45), 16, mark_discs=((0, 0, 46),)), "mark_discs"),
        (lambda: DiscGrid(3, 4, (45, 45), 16, mark_discs=((0, 0, 9), (0, 0, 9))), "mark_discs"),
        # the same after a half turn, and on a square grid after a quarter turn
        (lambda: DiscGrid(3, 5, (45, 45), 16, mark_discs=((1, 2, 20),)), "mark_discs"),
        (lambda: DiscGrid(3, 4, (45, 45), 16, mark_discs=((0, 0, 9), (2, 3, 9))), "mark_discs"),
        (lambda: Chessboard(2, 9, 25), "rows"),
        (lambda: Chessboard(6, 9, 0), "square_mm"),
        (lambda: Charuco(4, 5, 40, 40, "DICT_4X4_50"), "marker_mm"),
        (lambda: Charuco(4, 5, 40, 30, "DICT_9X9_50"), "dictionary"),
        (lambda: Charuco(12, 12, 40, 30, "DICT_4X4_50"), "dictionary"),
    ],
)
def test_a_value_out_of_limits_is_refused_by_name(build, key):
    with pytest.raises(SchemaError, match=f"^{key} = ") as caught:
        build()
    assert key in caught.value.remedy


def test_a_single_disc_has_no_pitch_to_break():
    assert len(Target.of(DiscGrid(1, 1, (1.0, 1.0), 10.0))) == 1
    assert len(Target.of(DiscGrid(1, 5, (20.0, 1.0), 10.0))) == 5


def test_a_quarter_turn_counts_only_on_square_grids():
    corners = ((0, 0, 20), (0, 3, 20), (3, 0, 20), (3, 3, 20))
    with pytest.raises(SchemaError, match="turn by 90 degrees"):
        DiscGrid(4, 4, (45, 45), 16, mark_discs=corners)
    DiscGrid(4, 4, (45, 45), 16, mark_discs=corners[:3])


def test_placement_by_a_transform_and_its_misuse():
    target = Target.of(Chessboard(3, 4, 25.0))
    pose = RigidTransform(rotation_from_vector([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    control = control_at(target, world_from_target=pose)
    assert np.abs(pose.inverse().apply(control.xyz_mm) - target.xyz_mm).max() < 1e-12
    for wrong in ({}, {"z_mm": 1.0, "world_from_target": pose}, {"z_mm": float("nan")}):
        with pytest.raises(InputError):
            control_at(target, **wrong)


def test_points_without_a_pattern():
    target = Target.of_points(("a", "b"), [[0, 0, 0], [1, 2, 3]], std_mm=[0, 0.1])
    assert target.kind == "points"
    assert target.pattern is None
    with pytest.raises(InputError, match="'a' appears twice"):
        Target.of_points(("a", "a"), np.zeros((2, 3)))
    with pytest.raises(SchemaError, match="std_mm"):
        Target.of(Chessboard(3, 4, 25.0), std_mm=-1)
