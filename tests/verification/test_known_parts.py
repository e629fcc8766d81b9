"""Parts whose tops are known: distances from outlines, and the table."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from closerange.errors import TableError
from closerange.verification.known_parts import Parts, read_parts

HEAD = "part,shape,x_mm,y_mm,z_mm,size_x_mm,size_y_mm,rotation_deg,height_mm\n"
BOX = "block,box,10,20,5,30,10,90,25\n"
DISC = "coin,disc,0,0,5,30,,,25\n"


def table(tmp_path, text):
    path = tmp_path / "parts.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_table_of_a_box_and_a_disc(tmp_path):
    parts = read_parts(table(tmp_path, HEAD + BOX + DISC))
    assert parts.part == ("block", "coin")
    assert parts.size_mm.tolist() == [[30, 10], [30, 30]]
    assert parts.rotation_rad.tolist() == [np.pi / 2, 0]
    assert parts.base_mm.tolist() == [-20, -20]
    with pytest.raises(ValueError, match="read-only"):
        parts.top_mm[0] = 0


def test_distance_from_the_outline_of_a_turned_box():
    parts = Parts.of(["a"], ["box"], [[10, 20, 5]], [[30, 10]], height_mm=25, rotation_deg=90)
    # turned by 90 degrees it is 10 wide in X and 30 long in Y
    xy = np.array([[10, 20], [15, 20], [10, 35], [10, 36], [16, 20], [18, 39], [14, 20]], float)
    want = [-5, 0, 0, 1, 1, 5, -1]
    np.testing.assert_allclose(parts.outside_mm(0, xy), want, atol=1e-12)


def test_a_turned_box_is_the_rectangle_of_its_corners():
    """By brute force: the distance from the nearest of many points on the four sides."""
    parts = Parts.of(["a"], ["box"], [[3, -7, 0]], [[34, 24]], height_mm=9, rotation_deg=20)
    turn = np.deg2rad(20)
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    corners = np.array([[-17, -12], [17, -12], [17, 12], [-17, 12], [-17, -12]]) @ axes + (3, -7)
    share = np.linspace(0, 1, 4001)[:, None]
    sides = np.concatenate([a + share * (b - a) for a, b in pairwise(corners)])
    xy = np.random.default_rng(1).uniform(-30, 30, (50, 2))
    want = np.linalg.norm(xy[:, None] - sides, axis=2).min(axis=1)
    np.testing.assert_allclose(np.abs(parts.outside_mm(0, xy)), want, atol=0.01)


def test_distance_from_a_disc():
    parts = Parts.of(["a"], ["disc"], [[1, 1, 0]], [[8, 8]], height_mm=3)
    xy = np.array([[1, 1], [4, 5], [1, 5], [1, -3.5]], float)
    np.testing.assert_allclose(parts.outside_mm(0, xy), [-4, 1, 0, 0.5], atol=1e-12)


@pytest.mark.parametrize(
    ("row", "message", "remedy"),
    [
        (BOX.replace("box", "ball"), "column 'shape': 'ball'", "box or disc"),
        (BOX.replace(",30,10,", ",30,,"), "'size_y_mm': the cell is empty", "both sides"),
        (BOX.replace(",30,10,", ",-30,10,"), "'size_x_mm': -30.0 mm", "above 0|both sides"),
        (BOX.replace(",90,25", ",90,0"), "without a height", "minus that of what"),
        (DISC.replace(",30,,", ",30,20,"), "20.0 mm for a disc of 30.0 mm", "blank"),
        (BOX + BOX, "part 'block'", "its own name"),
        (BOX.replace("block", ""), "the cell is empty", "write a name"),
    ],
)
def test_a_bad_row_is_named(tmp_path, row, message, remedy):
    with pytest.raises(TableError, match=message) as caught:
        read_parts(table(tmp_path, HEAD + row))
    assert any(word in caught.value.remedy for word in remedy.split("|"))


def test_a_missing_height_column_is_refused(tmp_path):
    text = (HEAD + BOX).replace(",height_mm", "").replace(",90,25", ",90")
    with pytest.raises(TableError, match="height_mm"):
        read_parts(table(tmp_path, text))
