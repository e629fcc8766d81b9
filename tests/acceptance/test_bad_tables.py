"""Bad tables through the command line: items 11, 30 to 39 and 43 of the list of bad inputs.

Each test is named after its item and feeds the file itself.
"""

from __future__ import annotations

import json
import math
import os

import numpy as np
import pytest

BAD_NUMBERS = {
    "blank": "",
    "not a number": "nan",
    "infinite": "inf",
    "overflow": "1e999",
    "word": "six",
    "hexadecimal": "0x10",
    "underscore": "1_000",
    "other digits": "٣",
    "decimal comma": "6,35",
    "thousands": "1,234.5",
    "unit": "6.35mm",
}


def first_row(column, text):
    """Return a change that writes a text into a column of the first row only."""
    rows = iter([True])

    def change(row):
        if next(rows, False):
            row[column] = text

    return change


def test_the_good_tables_give_a_good_rig_and_positions(tables, run, tmp_path):
    rig = run(*tables.calibrate, "-o", tmp_path / "rig.json")
    assert (rig.code, rig.stderr) == (0, "")
    assert "Trust        good" in rig.stdout
    positions = run(*tables.measure, "-o", tmp_path / "positions.csv")
    assert (positions.code, positions.stderr) == (0, "")
    rows = (tmp_path / "positions.csv").read_text(encoding="utf-8").splitlines()
    assert len(rows) == 64
    assert all(row.endswith(",") for row in rows[1:])  # no flags


@pytest.mark.parametrize("verb", ["calibrate", "measure"])
def test_item_01_missing_table(tables, refused, verb):
    tables.left.unlink()
    refused(getattr(tables, verb), 2, "left.csv", "no such file")


@pytest.mark.parametrize("content", [b"", b"\n\n", b"camera,point,x_px,y_px\n"])
def test_item_02_table_without_rows(tables, refused, content):
    tables.left.write_bytes(content)
    refused(tables.measure, 2, "left.csv")


@pytest.mark.parametrize(
    "content",
    [b"\x80\x04\x95\x10\x00", b"PK\x03\x04" + bytes(40), b"camera,point,x_px,y_px\nl,p,\0,1\n"],
)
@pytest.mark.parametrize("name", ["left.csv", "control.csv"])
def test_item_45_table_that_is_no_text(tables, refused, content, name):
    (tables.folder / name).write_bytes(content)
    refused(tables.calibrate, 2, name)


def test_item_30_doubled_point_in_the_control(tables, refused):
    lines = tables.control.read_text(encoding="utf-8").splitlines()
    tables.control.write_text("\n".join([*lines, lines[1]]), encoding="utf-8")
    refused(tables.calibrate, 2, "control.csv, row 65", "'r0c0'", "also in row 2")


def test_item_30_doubled_point_in_the_image_points(tables, refused):
    lines = tables.left.read_text(encoding="utf-8").splitlines()
    tables.left.write_text("\n".join([*lines, lines[5]]), encoding="utf-8")
    refused(tables.measure, 2, "left.csv, row 65", "also in row 6")


def test_item_30_the_same_table_twice(tables, refused):
    args = ["measure", str(tables.rig), str(tables.left), str(tables.left)]
    refused(args, 2, "left.csv", "'r0c0'")


def test_item_31_one_position_with_discordant_images(tables, run, tmp_path):
    """A second name for a known position, seen 0.9 px beside the first: told, both kept."""
    control = tables.control.read_text(encoding="utf-8").rstrip("\n")
    row = next(line for line in control.splitlines() if line.startswith("z3,r1c1,"))
    tables.control.write_text(f"{control}\n{row.replace('r1c1', 'again')}\n", encoding="utf-8")
    points = tables.left.read_text(encoding="utf-8").rstrip("\n")
    camera, placement, _, x, y, _ = next(
        line for line in points.splitlines() if line.startswith("left,z3,r1c1,")
    ).split(",")
    again = f"{camera},{placement},again,{float(x) + 0.9},{y},"
    tables.left.write_text(f"{points}\n{again}\n", encoding="utf-8")
    outcome = run(*tables.calibrate, "-o", tmp_path / "rig.json")
    assert outcome.code == 0
    assert "warning: " in outcome.stderr
    assert "z3/again" in outcome.stderr


def test_item_32_blunder_in_a_control_row_is_flagged_not_dropped(tables, run, tmp_path):
    def blunder(row):
        if (row["placement"], row["point"]) == ("z4", "r0c2"):
            row["x_mm"] = str(float(row["x_mm"]) + 0.75)

    tables.edit("control.csv", blunder)
    outcome = run(*tables.calibrate, "-o", tmp_path / "rig.json")
    assert outcome.code == 0
    assert "warning: 2 outliers are left out of the fit" in outcome.stderr
    assert "left/z4/r0c2" in outcome.stderr
    rig = json.loads((tmp_path / "rig.json").read_text(encoding="utf-8"))
    assert rig["trust"]["verdict"] == "good"
    assert rig["noise_px"] == pytest.approx(0.05, rel=0.2)  # 126 points: 6 % standard error
    rows = [
        dict(zip(rig["residuals"]["columns"], row, strict=True)) for row in rig["residuals"]["rows"]
    ]
    assert len(rows) == 126
    bad = [row for row in rows if row["flags"]]
    assert {(row["placement"], row["point"]) for row in bad} == {("z4", "r0c2")}
    assert {row["camera"] for row in bad} == {"left", "right"}
    assert {row["flags"] for row in bad} == {"outlier"}
    assert not any(row["fitted"] for row in bad)
    # the control row is suspected, and its error is estimated
    hints = [entry for entry in rig["report"]["outliers"] if "control_error_mm" in entry]
    np.testing.assert_allclose(hints[0]["control_error_mm"], [0.75, 0, 0], atol=0.1)


@pytest.mark.parametrize("what", BAD_NUMBERS)
@pytest.mark.parametrize("column", ["x_mm", "z_mm"])
def test_item_33_and_34_bad_number_in_the_control(tables, refused, what, column):
    tables.edit("control.csv", first_row(column, BAD_NUMBERS[what]))
    refused(tables.calibrate, 2, "control.csv, row 2", repr(column))


@pytest.mark.parametrize("what", BAD_NUMBERS)
def test_item_33_and_34_bad_number_in_the_image_points(tables, refused, what):
    tables.edit("right.csv", first_row("y_px", BAD_NUMBERS[what]))
    refused(tables.measure, 2, "right.csv, row 2", "'y_px'")


@pytest.mark.parametrize("what", BAD_NUMBERS)
def test_item_33_and_34_bad_number_in_the_truth(tables, run, refused, tmp_path, what):
    positions = tmp_path / "positions.csv"
    assert run(*tables.measure, "-o", positions).code == 0
    tables.edit("control.csv", first_row("y_mm", BAD_NUMBERS[what]))
    args = ["verify", "control", positions, "--truth", tables.control]
    refused(args, 2, "control.csv, row 2", "'y_mm'")


def test_item_33_blank_with_a_flag_is_passed_on(tables, run, tmp_path):
    def lost(row):
        if (row["placement"], row["point"]) == ("z2", "r2c2"):
            row.update(x_px="", y_px="", flags="not_found")

    tables.edit("left.csv", lost)
    outcome = run(*tables.measure, "-o", tmp_path / "positions.csv")
    assert outcome.code == 0
    rows = (tmp_path / "positions.csv").read_text(encoding="utf-8").splitlines()
    (row,) = [line for line in rows if line.startswith("z2,r2c2,")]
    assert row.startswith("z2,r2c2,,,,")  # no position, never (0, 0, 0)
    assert row.endswith("1,not_found|single_view")


def test_item_34_decimal_comma_unquoted(tables, refused):
    text = tables.control.read_text(encoding="utf-8").replace(
        "-45.0,45.0,-50.0", "-45,0,45,0,-50,0"
    )
    tables.control.write_text(text, encoding="utf-8")
    refused(tables.calibrate, 2, "control.csv, row 2", "decimal point")


def test_item_34_decimal_comma_has_its_own_remedy(tables, refused):
    tables.edit("control.csv", first_row("x_mm", "-45,0"))
    refused(tables.calibrate, 2, "remedy: write a decimal point, not a comma")


def test_item_34_semicolons(tables, refused):
    text = tables.control.read_text(encoding="utf-8").replace(",", ";").replace(".", ",")
    tables.control.write_text(text, encoding="utf-8")
    refused(tables.calibrate, 2, "control.csv", "semicolons")


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_item_35_lost_minus_is_an_outlier_with_a_hint(tables, run, tmp_path, axis):
    place = {"x": ("z5", "r1c0"), "y": ("z5", "r2c1"), "z": ("z1", "r1c1")}[axis]

    def lose(row):
        if (row["placement"], row["point"]) == place:
            assert row[f"{axis}_mm"].startswith("-")
            row[f"{axis}_mm"] = row[f"{axis}_mm"][1:]

    tables.edit("control.csv", lose)
    outcome = run(*tables.calibrate, "-o", tmp_path / "rig.json")
    assert outcome.code == 0
    assert "/".join(place) in outcome.stderr
    assert f"sign of {axis} lost" in outcome.stderr
    rig = json.loads((tmp_path / "rig.json").read_text(encoding="utf-8"))
    assert rig["trust"]["verdict"] == "good"
    assert rig["noise_px"] == pytest.approx(0.05, rel=0.2)


def test_item_35_lost_decimal_point_is_an_outlier_too(tables, run, tmp_path):
    def lose(row):
        if (row["placement"], row["point"]) == ("z4", "r1c2"):
            assert row["x_mm"] == "45.0"
            row["x_mm"] = "450"

    tables.edit("control.csv", lose)
    outcome = run(*tables.calibrate, "--model", "brown", "-o", tmp_path / "rig.json")
    assert outcome.code == 0
    assert "z4/r1c2" in outcome.stderr
    rig = json.loads((tmp_path / "rig.json").read_text(encoding="utf-8"))
    assert rig["trust"]["verdict"] == "good"
    column = rig["residuals"]["columns"].index("flags")
    flags = [row[column] for row in rig["residuals"]["rows"]]
    assert flags.count("outlier") == 2  # one row, both cameras
    assert len(flags) == 126  # kept in the table


@pytest.mark.parametrize(
    ("table", "old", "new"),
    [
        ("control.csv", "x_mm", "x"),
        ("control.csv", "z_mm", "z_inch"),
        ("left.csv", "x_px", "x"),
    ],
)
def test_item_36_column_without_its_unit(tables, refused, table, old, new):
    path = tables.folder / table
    path.write_text(path.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    refused(tables.calibrate, 2, table, f"{old!r} is missing", "units")


@pytest.mark.parametrize(("factor", "words"), [(25.4, "inches"), (10.0, "cm"), (1000.0, "m ")])
def test_item_36_control_in_another_unit_than_the_discs(disc_tables, refused, factor, words):
    def scale(row):
        for name in ("x_mm", "y_mm", "z_mm"):
            row[name] = repr(float(row[name]) / factor)

    disc_tables.edit("control.csv", scale)
    refused(disc_tables.calibrate, 2, words, "against mm", "disc_diameter_mm")


@pytest.mark.parametrize("offset_mm", [0.0, 60.0])
def test_item_39_mm_and_px_columns_exchanged(tables, refused, offset_mm):
    """Pixels stand in the control, millimetres in the points tables; at 60 mm all positive."""
    pixels, numbers = {}, {}

    def read_points(row):
        pixels[row["placement"], row["point"]] = row["x_px"], row["y_px"]

    tables.edit("left.csv", read_points)

    def exchange_control(row):
        key = row["placement"], row["point"]
        numbers[key] = [str(float(row[name]) + offset_mm) for name in ("x_mm", "y_mm")]
        row["x_mm"], row["y_mm"] = pixels[key]

    tables.edit("control.csv", exchange_control)

    def exchange_points(row):
        row["x_px"], row["y_px"] = numbers[row["placement"], row["point"]]

    for name in ("left.csv", "right.csv"):
        tables.edit(name, exchange_points)
    if offset_mm:
        refused(tables.calibrate, 1)
    else:
        refused(tables.calibrate, 2, "outside of the image", "mm and px columns exchanged")


@pytest.mark.parametrize("special", ["/dev/zero", "/dev/null", "pipe", "folder"])
@pytest.mark.parametrize("name", ["control.csv", "left.csv"])
def test_item_49_table_that_is_a_device_or_a_pipe(tables, refused, special, name):
    """Neither hangs nor fills the memory."""
    path = tables.folder / name
    path.unlink()
    if special == "pipe":
        os.mkfifo(path)
    elif special == "folder":
        path.mkdir()
    else:
        path.symlink_to(special)
    refused(tables.calibrate, 2, name)


def test_item_43_points_of_a_camera_that_the_rig_does_not_have(tables, refused):
    tables.edit("right.csv", lambda row: row.update(camera="rear"))
    refused(tables.measure, 2, "'rear'", "left, right")


def test_item_11_and_43_points_outside_of_the_rigs_image(tables, refused):
    """The calibration of another, smaller camera: points do not fit into its image."""
    document = json.loads(tables.rig.read_text(encoding="utf-8"))
    for camera in document["cameras"]:
        camera["size_px"] = [640, 512]
    tables.rig.write_text(json.dumps(document), encoding="utf-8")
    refused(tables.measure, 2, "640", "512")


def test_item_43_calibration_of_other_cameras_is_noticed(tables, run, tmp_path):
    """The cameras' names and sizes fit but the rays miss: every row says so, and a warning."""
    document = json.loads(tables.rig.read_text(encoding="utf-8"))
    left, right = document["cameras"]
    left["camera_from_world"], right["camera_from_world"] = (
        right["camera_from_world"],
        left["camera_from_world"],
    )
    right["matrix_px"][1][2] += 40.0
    tables.rig.write_text(json.dumps(document), encoding="utf-8")
    outcome = run(*tables.measure, "-o", tmp_path / "positions.csv")
    assert outcome.code == 1  # no row without a flag
    assert "error: the rays of 63 of 63 points miss each other" in outcome.stderr
    rows = (tmp_path / "positions.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert all("residual" in row.rsplit(",", 1)[1] for row in rows)
    result = tmp_path / "result.json"
    told = run(
        "verify", "control", tmp_path / "positions.csv", "--truth", tables.control, "-o", result
    )
    assert told.code == 1
    assert "63 of 63 rows with a true position could not be used" in told.stderr
    assert result.is_file()


def test_item_44_bumped_camera_is_noticed(tables, run, tmp_path):
    """One camera turned by 1 mrad after the calibration: 5 px across the epipolar lines."""
    tables.edit("right.csv", lambda row: row.update(y_px=str(float(row["y_px"]) + 4.8)))
    outcome = run(*tables.measure, "-o", tmp_path / "positions.csv")
    assert outcome.code == 1
    assert "a camera was moved" in outcome.stderr


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (["--image-size", "left=1280"], "NAME=WxH"),
        (["--image-size", "left=1280x1024"], "'right'"),
        (["--image-size", "left=0x1024", "--image-size", "right=1280x1024"], "NAME=WxH"),
        (["--image-size", "left=1024x1280", "--image-size", "right=1280x1024"], "exchanged"),
        (["--image-size", "left=640x512", "--image-size", "right=640x512"], "full image"),
    ],
)
def test_item_11_image_size_that_does_not_fit(tables, refused, option, words):
    args = ["calibrate", tables.left, tables.right, "--control", tables.control, *option]
    if words == "exchanged":
        # so that width matters: a point right of 1024
        tables.edit("left.csv", first_row("x_px", "1100.0"))
    refused(args, 2, words)


@pytest.mark.parametrize(
    ("column", "text"),
    [
        ("x_mm", ""),
        ("x_mm", "inf"),
        ("cov_xx_mm2", ""),
        ("cov_yy_mm2", "-1"),
        ("cov_xy_mm2", "9"),
        ("cameras", "1.5"),
        ("cameras", "-2"),
        ("cameras", "9" * 30),
        ("flags", "odd"),
        ("point", ""),
    ],
)
def test_item_33_bad_cell_in_the_positions(tables, run, refused, column, text):
    positions = tables.folder / "positions.csv"
    assert run(*tables.measure, "-o", positions).code == 0
    tables.edit("positions.csv", first_row(column, text))
    args = ["verify", "single-point", positions, "--truth", tables.control]
    refused(args, 2, "positions.csv, row 2", "'cov_xx_mm2'" if "cov" in column else "")


def test_positions_without_any_truth(tables, run, refused, tmp_path):
    positions = tmp_path / "positions.csv"
    assert run(*tables.measure, "-o", positions).code == 0
    tables.edit("control.csv", lambda row: row.update(point=f"other {row['point']}"))
    for kind in ("control", "single-point"):
        refused(["verify", kind, positions, "--truth", tables.control], 1)


def test_numbers_are_read_alike_in_every_locale(tables, run, tmp_path, monkeypatch):
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    assert run(*tables.measure, "-o", tmp_path / "positions.csv").code == 0
    row = (tmp_path / "positions.csv").read_text(encoding="utf-8").splitlines()[1]
    assert math.isclose(float(row.split(",")[2]), -45.0, abs_tol=0.1)
