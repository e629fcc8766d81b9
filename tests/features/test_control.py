"""The control table: known world points."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.errors import InputError, TableError
from closerange.features.control import ControlPoints, read_control, write_control
from closerange.features.image_points import ImagePoints


@pytest.fixture
def read(tmp_path):
    def of(text):
        path = tmp_path / "control.csv"
        path.write_text(text, "utf-8")
        return read_control(path)

    return of


def test_minimal_table(read):
    control = read("z_mm,point,x_mm,y_mm\n3,01,1,2\n6,1,4,5\n")
    assert control.point == ("01", "1")
    assert control.xyz_mm.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert control.std_mm.tolist() == [0, 0]
    assert control.placement == ("", "")
    assert not control.check.any()


def test_a_row_of_the_same_placement_wins_over_a_blank_one():
    control = ControlPoints.of(
        ["p", "p", "q"], [[0, 0, 0], [0, 0, 9], [5, 5, 5]], placement=["", "up", "up"]
    )
    rows = control.rows_for(["up", "down", "", "up", "down"], ["p", "p", "p", "q", "q"])
    assert rows.tolist() == [1, 0, 0, 2, -1]
    backwards = ControlPoints.of(
        ["p", "p", "q"][::-1], np.zeros((3, 3)), placement=["up", "up", ""]
    )
    assert backwards.rows_for(["up", "down"], ["p", "p"]).tolist() == [1, 2]


def test_names_are_opaque_and_unknown_points_have_no_row():
    control = ControlPoints.of(["01"], [[0, 0, 0]])
    points = ImagePoints.of(camera="c", placement="z", point=["1", "01"], xy_px=np.zeros((2, 2)))
    assert control.rows_of(points).tolist() == [-1, 0]
    assert control.rows_for([], []).tolist() == []


def test_standard_deviations(read):
    control = read("point,x_mm,y_mm,z_mm,std_mm\na,0,0,0,0.02\nb,0,0,0,\n")
    assert control.std_mm.tolist() == [0.02, 0]
    with pytest.raises(TableError, match=r"row 2, column 'std_mm': -0.1 mm"):
        read("point,x_mm,y_mm,z_mm,std_mm\na,0,0,0,-0.1\n")


def test_roles(read):
    control = read("point,x_mm,y_mm,z_mm,role\na,0,0,0,\nb,0,0,0,calibration\nc,0,0,0,check\n")
    assert control.check.tolist() == [False, False, True]
    with pytest.raises(TableError, match="row 2, column 'role': 'Check'; known roles"):
        read("point,x_mm,y_mm,z_mm,role\na,0,0,0,Check\n")


def test_blank_coordinates_are_errors(read):
    with pytest.raises(TableError, match="row 3, column 'z_mm': the cell is empty"):
        read("point,x_mm,y_mm,z_mm\na,0,0,0\nb,0,0,\n")


def test_decimal_comma_names_the_comma(read):
    with pytest.raises(TableError, match="row 2, column 'x_mm': '6,35'") as caught:
        read('point,x_mm,y_mm,z_mm\na,"6,35",0,0\n')
    assert "comma" in caught.value.remedy


def test_a_column_without_unit_is_refused_with_the_reason(read):
    with pytest.raises(
        TableError, match="column 'x_mm' is missing; found point, x, y, z"
    ) as caught:
        read("point,x,y,z\na,1,2,3\n")
    assert "units belong to the names" in caught.value.remedy


def test_a_point_that_appears_twice_in_a_placement(read):
    with pytest.raises(TableError, match=r"row 3, column 'point': .* is also in row 2"):
        read("placement,point,x_mm,y_mm,z_mm\nz,a,1,2,3\nz,a,1,2,4\n")
    assert len(read("placement,point,x_mm,y_mm,z_mm\nz,a,1,2,3\ny,a,1,2,4\n,a,0,0,0\n")) == 3


def test_round_trip_is_exact_and_byte_identical(tmp_path):
    control = ControlPoints.of(
        ["a", "b, c"],
        [[0.1 + 0.2, -1e-9, 50], [1, 2, 3]],
        placement=["", "z -50.0"],
        std_mm=[0, 0.013],
        check=[True, False],
    )
    write_control(control, tmp_path / "a.csv")
    read = read_control(tmp_path / "a.csv")
    assert (read.placement, read.point) == (control.placement, control.point)
    for name in ("xyz_mm", "std_mm", "check"):
        assert (getattr(read, name) == getattr(control, name)).all()
    write_control(read, tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_arrays_cannot_be_written():
    control = ControlPoints.of(["a"], [[0, 0, 0]])
    for name in ("xyz_mm", "std_mm", "check"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(control, name)[:] = 1


def test_columns_of_unequal_length_are_refused():
    with pytest.raises(ValueError, match="xyz_mm has shape"):
        ControlPoints.of(["a", "b"], [[0, 0, 0]])
    with pytest.raises(ValueError, match="differ in length"):
        ControlPoints.of(["a"], [[0, 0, 0]], placement=["x", "y"])


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_position_that_is_not_known_is_refused_by_name(value):
    with pytest.raises(InputError, match=r"control point 'b' of placement 'p1': its position"):
        ControlPoints.of(["a", "b"], [[0, 0, 0], [0, value, 0]], placement=["", "p1"])


@pytest.mark.parametrize("value", [np.nan, np.inf, -0.1])
def test_what_is_no_standard_deviation_is_refused_by_name(value):
    with pytest.raises(InputError, match=r"control point 'b': .* mm is no standard deviation"):
        ControlPoints.of(["a", "b"], np.zeros((2, 3)), std_mm=[0.0, value])
