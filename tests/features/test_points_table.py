"""The points table: the public contract of image points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from closerange.errors import CloseRangeWarning, InputError, TableError
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points, write_points
from closerange.flags import Flag


@pytest.fixture
def read(tmp_path):
    def of(text):
        path = tmp_path / "points.csv"
        path.write_text(text, "utf-8")
        return read_points(path)

    return of


def rich():
    return ImagePoints.of(
        camera=["left", "left", "right", "right"],
        placement=["z -50.0", "z -50.0", "a,b", 'q"q'],
        reading=["1", "2", "", ""],
        point=["r0c1", "01", "1", "µ"],
        xy_px=[[0.1 + 0.2, 1e-17], [np.nan, np.nan], [639.5, 1e6], [-0.0, 3]],
        cov_px2=[np.eye(2) / 3, np.full((2, 2), np.nan), [[2, -1], [-1, 1]], np.eye(2)],
        flags=[0, int(Flag.not_found), int(Flag.saturated | Flag.at_border), 0],
        ellipse=[[5, 5, 0], [np.nan] * 3, [5.5, 4.4, -1.2], [2, 1, 3]],
        disc_diameter_mm=[16, np.nan, 8.3, 1],
        noise_cov_px2=[np.eye(2) / 7, np.full((2, 2), np.nan), [[1, -0.5], [-0.5, 1]], np.eye(2)],
    )


def assert_same(one, other):
    assert one.keys() == other.keys()
    for name in ("xy_px", "cov_px2", "noise_cov_px2", "flags", "ellipse", "disc_diameter_mm"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_round_trip_is_exact_and_byte_identical(tmp_path):
    points = rich()
    points.to_csv(tmp_path / "a.csv")
    read = read_points(tmp_path / "a.csv")
    assert_same(read, points)
    write_points(read, tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=2, max_size=2))
def test_any_position_round_trips(tmp_path, xy):
    ImagePoints.of(camera="c", point=["1"], xy_px=[xy]).to_csv(tmp_path / "t.csv")
    assert read_points(tmp_path / "t.csv").xy_px.tolist() == [xy]


def test_columns_without_content_are_left_out(tmp_path):
    ImagePoints.of(camera="c", point=["1"], xy_px=[[1, 2]]).to_csv(tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text() == (
        "camera,placement,point,x_px,y_px,flags\nc,,1,1.0,2.0,\n"
    )


def test_the_four_required_columns_are_enough_in_any_order(read):
    points = read("y_px,point,x_px,camera\n2,01,1,left\n4,1,3,left\n")
    assert points.keys() == [("left", "", "", "01"), ("left", "", "", "1")]
    assert points.xy_px.tolist() == [[1, 2], [3, 4]]
    assert np.isnan(points.cov_px2).all()


@pytest.mark.parametrize("missing", ["camera", "point", "x_px", "y_px"])
def test_each_required_column_is_required(read, missing):
    header = [name for name in ("camera", "point", "x_px", "y_px") if name != missing]
    with pytest.raises(TableError, match=f"column '{missing}' is missing"):
        read(",".join(header) + "\n1,1,1\n")


def test_a_matches_table_is_a_points_table(read):
    points = read("camera,point,x_px,y_px,mismatch\nleft,e1,1,2,\nright,e1,1,2,0.1\n")
    assert len(points) == 2


def test_unknown_columns_are_reported_once(read):
    with pytest.warns(CloseRangeWarning, match="unknown columns ignored: colour") as caught:
        read("camera,point,x_px,y_px,colour\nleft,1,1,2,red\nleft,2,1,2,red\n")
    assert len(caught) == 1


def test_a_row_without_position_needs_a_flag(read):
    points = read("camera,point,x_px,y_px,flags\nleft,1,,,not_found\n")
    assert np.isnan(points.xy_px).all()
    assert points.flags.tolist() == [int(Flag.not_found)]
    for cells, column in ((",", "x_px"), ("1,", "y_px"), (",1", "x_px")):
        with pytest.raises(TableError, match=f"row 2, column '{column}': the cell is empty and"):
            read(f"camera,point,x_px,y_px,flags\nleft,1,{cells},\n")


def test_half_a_position_with_a_flag_is_no_position(read):
    points = read("camera,point,x_px,y_px,flags\nleft,1,5,,occluded\n")
    assert np.isnan(points.xy_px).all()


def test_flags(read):
    points = read("camera,point,x_px,y_px,flags\nleft,1,1,1,at_border|saturated\n")
    assert points.flags.tolist() == [int(Flag.at_border | Flag.saturated)]
    with pytest.raises(TableError, match="row 2, column 'flags': unknown flag 'bad'"):
        read("camera,point,x_px,y_px,flags\nleft,1,1,1,bad\n")


def test_a_row_that_appears_twice_names_both(read):
    with pytest.raises(TableError, match=r"row 4, column 'point': .* is also in row 2"):
        read("camera,point,x_px,y_px\nleft,1,1,1\nleft,01,1,1\nleft,1,2,2\n")


def test_names_may_not_be_empty(read):
    for row, column in (("left,,1,1", "point"), (",1,1,1", "camera")):
        with pytest.raises(TableError, match=f"row 2, column '{column}': the cell is empty"):
            read(f"camera,point,x_px,y_px\n{row}\n")


@pytest.mark.parametrize("cell", ["nan", '"6,35"', "1e999", "x"])
def test_bad_numbers_name_their_cell(read, cell):
    with pytest.raises(TableError, match="row 3, column 'y_px'"):
        read(f"camera,point,x_px,y_px\nleft,1,1,1\nleft,2,1,{cell}\n")


@pytest.mark.parametrize(
    "terms",
    [
        "1,2,1",  # correlation beyond 1
        "1,1,1",  # exactly 1
        "-1,0,1",
        "0,0,0",
        "1,,1",  # one term missing
        ",,1",
    ],
)
def test_what_is_not_a_covariance_is_refused(read, terms):
    for kind in ("cov", "noise"):
        header = f"camera,point,x_px,y_px,{kind}_xx_px2,{kind}_xy_px2,{kind}_yy_px2"
        message = f"row 2, column '{kind}_xx_px2': .* is not a covariance"
        with pytest.raises(TableError, match=message):
            read(f"{header}\nleft,1,1,1,{terms}\n")


def test_some_rows_may_have_a_covariance(read):
    header = "camera,point,x_px,y_px,cov_xx_px2,cov_xy_px2,cov_yy_px2"
    points = read(f"{header}\nleft,1,1,1,2,-1,3\nleft,2,1,1,,,\n")
    assert points.cov_px2[0].tolist() == [[2, -1], [-1, 3]]
    assert np.isnan(points.cov_px2[1]).all()


def test_noise_is_read_apart_from_the_covariance(read):
    header = "camera,point,x_px,y_px,noise_xx_px2,noise_xy_px2,noise_yy_px2"
    points = read(f"{header}\nleft,1,1,1,2,-1,3\nleft,2,1,1,,,\n")
    assert points.noise_cov_px2[0].tolist() == [[2, -1], [-1, 3]]
    assert np.isnan(points.noise_cov_px2[1]).all()
    assert np.isnan(points.cov_px2).all()


@pytest.mark.parametrize("terms", ["4,5,0", "0,0,0", "5,-4,0", "5,,0", "5,4,"])
def test_what_is_not_an_ellipse_is_refused(read, terms):
    header = "camera,point,x_px,y_px,ellipse_a_px,ellipse_b_px,ellipse_angle_rad"
    with pytest.raises(TableError, match=r"row 2, column 'ellipse_a_px': .*a >= b > 0"):
        read(f"{header}\nleft,1,1,1,{terms}\n")


def test_a_circle_is_an_ellipse(read):
    header = "camera,point,x_px,y_px,ellipse_a_px,ellipse_b_px,ellipse_angle_rad"
    assert read(f"{header}\nleft,1,1,1,5,5,0\n").ellipse.tolist() == [[5, 5, 0]]


@pytest.mark.parametrize("diameter", ["0", "-16"])
def test_a_disc_has_a_positive_diameter(read, diameter):
    with pytest.raises(TableError, match="row 2, column 'disc_diameter_mm'"):
        read(f"camera,point,x_px,y_px,disc_diameter_mm\nleft,1,1,1,{diameter}\n")


def test_several_tables(tmp_path):
    for name in ("left", "right"):
        ImagePoints.of(camera=name, point=["1"], xy_px=[[1, 2]]).to_csv(tmp_path / f"{name}.csv")
    joined = read_points(tmp_path / "left.csv", tmp_path / "right.csv")
    assert joined.cameras == ("left", "right")
    with pytest.raises(TableError, match=r"left\.csv: point '1' of camera 'left'"):
        read_points(tmp_path / "left.csv", tmp_path / "left.csv")
    with pytest.raises(InputError, match="no points table"):
        read_points()
