"""The target file: what it takes and what it refuses."""

from __future__ import annotations

import pytest

from closerange.errors import CloseRangeWarning, FileError, InputError, SchemaError
from closerange.features.target import Charuco, Chessboard, DiscGrid, Target
from closerange.features.target_file import read_target

DESIGN = """
kind = "disc-grid"             # as in the design
rows = 3
columns = 3
pitch_mm = [45.0, 45.0]
disc_diameter_mm = 16.0
polarity = "white-on-dark"     # or "dark-on-white"
orientation = "upright"
"""
BOARD = 'kind = "chessboard"\nrows = 6\ncolumns = 9\nsquare_mm = 25\n'
CHARUCO = (
    'kind = "charuco"\nrows = 4\ncolumns = 5\nsquare_mm = 54.0\nmarker_mm = 40\n'
    'dictionary = "DICT_4X4_50"\n'
)


def written(folder, text):
    path = folder / "plate.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_published_example_is_read(tmp_path):
    target = read_target(written(tmp_path, DESIGN))
    assert target.pattern == DiscGrid(3, 3, (45.0, 45.0), 16.0, "white-on-dark", "upright")
    assert target.point[0] == "r0c0"


def test_orientation_defaults_to_marks_where_there_are_marks(tmp_path):
    text = DESIGN.replace('orientation = "upright"', "")
    with pytest.warns(CloseRangeWarning, match=r"plate.toml: .*same after half a turn"):
        assert read_target(written(tmp_path, text)).pattern.orientation == "upright"
    text += "mark_discs = [[0, 0, 20]]\n"
    pattern = read_target(written(tmp_path, text)).pattern
    assert pattern.orientation == "marks"
    assert pattern.mark_discs == ((0, 0, 20.0),)


def test_only_a_symmetric_board_has_an_orientation(tmp_path):
    board = BOARD.replace("columns = 9", "columns = 8") + 'orientation = "upright"\n'
    assert read_target(written(tmp_path, board)).pattern == Chessboard(6, 8, 25.0, "upright")
    assert read_target(written(tmp_path, BOARD)).pattern.orientation == ""
    for text in (BOARD + 'orientation = "upright"', board.replace("upright", "marks")):
        with pytest.raises(SchemaError, match=r"orientation = .*two odd or two even"):
            read_target(written(tmp_path, text))


def test_a_single_disc_needs_no_pitch(tmp_path):
    text = 'kind = "disc-grid"\nrows = 1\ncolumns = 1\ndisc_diameter_mm = 10\n'
    target = read_target(written(tmp_path, text + 'polarity = "white-on-dark"'))
    assert target.xyz_mm.tolist() == [[0.0, 0.0, 0.0]]
    with pytest.raises(SchemaError, match="'pitch_mm' is missing"):
        read_target(written(tmp_path, text.replace("rows = 1", "rows = 2") + 'polarity = "x"'))


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        (
            DESIGN.replace("45.0]", "30.3]") + "std_mm = 0.013",
            DiscGrid(3, 3, (45.0, 30.3), 16.0, "white-on-dark", "upright"),
        ),
        (BOARD + "std_mm = 0.013", Chessboard(6, 9, 25.0)),
        (CHARUCO + "std_mm = 0.013", Charuco(4, 5, 54.0, 40.0, "DICT_4X4_50")),
    ],
    ids=["disc-grid", "chessboard", "charuco"],
)
def test_each_kind_is_read_with_the_uncertainty_of_its_points(tmp_path, text, pattern):
    target = read_target(written(tmp_path, text))
    assert target.pattern == pattern
    assert target.kind == text.split('"')[1]
    assert target.std_mm.tolist() == [0.013] * len(Target.of(pattern))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (DESIGN + "colour = 1\n", "unknown key 'colour'"),
        (DESIGN.replace("rows = 3", ""), "key 'rows' is missing"),
        (DESIGN.replace('polarity = "white-on-dark"', ""), "key 'polarity' is missing"),
        (DESIGN.replace("rows = 3", "rows = 3.0"), "rows = 3.0; expected a whole number"),
        (DESIGN.replace("rows = 3", "rows = true"), "rows = True; expected a whole number"),
        (DESIGN.replace("16.0", '"16"'), "disc_diameter_mm = '16'; expected a number"),
        (DESIGN.replace("16.0", "inf"), "disc_diameter_mm = inf"),
        (DESIGN.replace("16.0", "-16.0"), "disc_diameter_mm = -16.0"),
        (DESIGN.replace("16.0", "45.0"), "disc_diameter_mm = 45.0; .*pitch, here 45.0 mm"),
        (DESIGN.replace("16.0", "1" + "0" * 400), "disc_diameter_mm"),
        (DESIGN.replace("16.0", "1" + "0" * 5000), "not TOML"),
        (DESIGN.replace("[45.0, 45.0]", "45.0"), "pitch_mm = 45.0; expected a list of 2"),
        (DESIGN.replace('"upright"', '""'), "orientation = ''"),
        (DESIGN.replace('"upright"', "1"), "orientation = 1; expected a text"),
        (DESIGN + "mark_discs = [[0, 0]]\n", "mark_discs"),
        (DESIGN + "mark_discs = [[0, 0.5, 9]]\n", "mark_discs = 0.5; expected a whole number"),
        (DESIGN + "mark_discs = 7\n", "mark_discs = 7"),
        (DESIGN + "mark_discs = [[0, 9, 9]]\n", "mark_discs .*3 rows, 3 columns"),
        (DESIGN + "std_mm = -1\n", "std_mm = -1"),
        (DESIGN + "rows = 4\n", "not TOML"),
        (DESIGN.replace("disc-grid", "disks"), "kind = 'disks'; one of disc-grid"),
        (DESIGN.replace('"disc-grid"', "3"), "kind = 3; expected a text"),
        ("rows = 3", "key 'kind' is missing"),
        ("x = " + "[" * 5000, "not TOML"),
        (BOARD + "marker_mm = 3\n", "unknown key 'marker_mm'"),
        (BOARD.replace("25", "0"), "square_mm = 0.0"),
        (CHARUCO.replace("DICT_4X4_50", "4x4"), "dictionary = '4x4'; one of .*DICT_4X4_50"),
        (CHARUCO.replace("= 40", "= 54"), "marker_mm = 54.0; smaller than the square"),
    ],
)
def test_a_wrong_file_is_refused_by_file_key_and_value(tmp_path, text, match):
    path = written(tmp_path, text)
    with pytest.raises(SchemaError, match=match) as caught:
        read_target(path)
    assert caught.value.message.startswith(f"{path}: ")
    assert caught.value.message.count(str(path)) == 1
    assert caught.value.remedy


@pytest.mark.parametrize(
    "name",
    ["../points.csv", "/etc/passwd", "sub/../../points.csv", "..\\\\points.csv", "C:\\\\p.csv",
     "\\\\\\\\host\\\\p.csv", "", "link.csv", "loop/points.csv"],
)  # fmt: skip
def test_the_points_file_cannot_leave_the_folder(tmp_path, name):
    folder = tmp_path / "targets"
    folder.mkdir()
    table = "point,x_mm,y_mm,z_mm\na,0,0,0\n"
    (tmp_path / "points.csv").write_text(table)
    (folder / "link.csv").symlink_to(tmp_path / "points.csv")
    (folder / "loop").symlink_to(tmp_path)
    path = written(folder, f'kind = "points"\nfile = "{name}"\n')
    with pytest.raises(SchemaError, match=r"file = .*folder or below"):
        read_target(path)


def test_points_come_from_a_control_table_below_the_folder(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "p.csv").write_text("point,x_mm,y_mm,z_mm,std_mm\nb,1,2,3,0.5\na,4,5,6,\n")
    target = read_target(written(tmp_path, 'kind = "points"\nfile = "sub/p.csv"\n'))
    assert target.point == ("b", "a")
    assert target.std_mm.tolist() == [0.5, 0.0]
    (tmp_path / "sub" / "p.csv").write_text("point,x_mm,y_mm,z_mm,placement\nb,1,2,3,k\n")
    with pytest.raises(SchemaError, match="no placement"):
        read_target(tmp_path / "plate.toml")


def test_missing_files_are_file_errors(tmp_path):
    with pytest.raises(FileError):
        read_target(tmp_path / "none.toml")
    with pytest.raises(InputError):
        read_target(written(tmp_path, 'kind = "points"\nfile = "none.csv"\n'))
