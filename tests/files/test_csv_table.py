"""The CSV dialect: header by name, decimal points, nothing guessed."""

from __future__ import annotations

import locale
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from closerange.errors import CloseRangeWarning, FileError, TableError
from closerange.files.csv_table import (
    check_unique,
    flag_cell,
    float_cell,
    float_text,
    read_csv,
    text_cell,
    write_csv,
)
from closerange.flags import Flag


@pytest.fixture
def table(tmp_path):
    def read(content, *, required=("a", "b"), optional=("c",)):
        path = tmp_path / "t.csv"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return read_csv(path, required=required, optional=optional)

    return read


def test_columns_in_any_order(table):
    read = table("c,b,a\n3,2,1\n6,5,4\n")
    assert (read.texts("a"), read.texts("b"), read.texts("c")) == (
        ["1", "4"],
        ["2", "5"],
        ["3", "6"],
    )
    assert len(read) == 2


def test_a_missing_optional_column_is_blank(table):
    read = table("a,b\n1,2\n")
    assert read.texts("c") == [""]
    assert math.isnan(read.floats("c", blank=math.nan)[0])


def test_outer_blanks_go_and_inner_ones_stay(table):
    read = table(" a , b\n  x y ,\t2 \n")
    assert read.texts("a") == ["x y"]
    assert read.floats("b") == [2.0]


@pytest.mark.parametrize("ends", ["\n", "\r\n", "\r"])
def test_line_ends_and_byte_order_mark(table, ends):
    read = table(b"\xef\xbb\xbf" + ends.join(["a,b", "1,2", "3,4"]).encode())
    assert read.floats("a") == [1.0, 3.0]


def test_quoted_commas_and_quotes(table):
    assert table('a,b\n"x, ""y""",2\n').texts("a") == ['x, "y"']


def test_row_numbers_are_lines_of_the_file(table):
    read = table('a,b\n\n1,2\n"two\nlines",4\n\n , \n5,6\n')
    assert read.line == [3, 4, 8]
    assert read.where(2, "b").endswith("t.csv, row 8, column 'b'")
    assert read.texts("a") == ["1", "two\nlines", "5"]


def test_decimal_comma_in_quotes_names_the_comma(table):
    with pytest.raises(TableError, match="row 2, column 'b': '6,35' is not a number") as caught:
        table('a,b\nx,"6,35"\n').floats("b")
    assert caught.value.remedy == "write a decimal point, not a comma"
    assert caught.value.exit_code == 2


def test_decimal_comma_that_splits_the_row_names_the_comma(table):
    with pytest.raises(TableError, match="row 3: 3 cells, the header has 2") as caught:
        table("a,b\nx,1.0\nx,6,35\n")
    assert "decimal comma" in caught.value.remedy


@pytest.mark.parametrize("row", ["1", "1,2,3"])
def test_ragged_rows(table, row):
    with pytest.raises(TableError, match="row 2"):
        table(f"a,b\n{row}\n")


def test_semicolons(table):
    with pytest.raises(TableError, match="column 'a' is missing") as caught:
        table("a;b\n1;2\n")
    assert "commas, not semicolons" in caught.value.remedy


def test_missing_column_is_named_with_those_found(table):
    with pytest.raises(TableError, match="column 'b' is missing; found a, x") as caught:
        table("a,x\n1,2\n")
    assert "a, b" in caught.value.remedy


def test_a_column_that_appears_twice(table):
    with pytest.raises(TableError, match="column 'a' appears twice"):
        table("a,b,a\n1,2,3\n")


def test_unknown_columns_warn_once_and_are_left_out(table):
    with pytest.warns(CloseRangeWarning, match="unknown columns ignored: x, y") as caught:
        read = table("x,a,y,b\n9,1,9,2\n9,3,9,4\n")
    assert len(caught) == 1
    assert set(read.columns) == {"a", "b"}


@pytest.mark.parametrize("content", ["\n\n", " , \n"])
def test_no_header(table, content):
    with pytest.raises(TableError, match="no header"):
        table(content)


def test_header_only(table):
    with pytest.raises(TableError, match="without rows"):
        table("a,b\n\n")


def test_empty_and_missing_files(table, tmp_path):
    with pytest.raises(FileError, match="empty"):
        table("")
    with pytest.raises(FileError, match="no such file"):
        read_csv(tmp_path / "none.csv", required=["a"])


def test_nul_bytes(table):
    with pytest.raises(TableError, match="NUL"):
        table(b"a,b\n1,\x002\n")


def test_an_open_quote_names_its_row(table):
    with pytest.raises(TableError, match="row 3"):
        table('a,b\n1,2\n"3,4\n5,6\n')


def test_a_cell_above_the_reader_s_limit_is_an_error_not_a_traceback(table):
    with pytest.raises(TableError, match="row 2"):
        table(f"a,b\n{'x' * 200_000},1\n")


@pytest.mark.parametrize(
    "text",
    [
        *("nan", "NaN", "inf", "-Infinity", "1_000", "0x10", "1e", ".", "+", "--1", "1 000", "1d3"),
        *("٣", "1.2.3", "1e5.0", "6.35 mm", "1,234.5", "true", "½"),
    ],
)
def test_not_a_number(text):
    with pytest.raises(TableError, match="is not a number"):
        float_cell(text, "t.csv, row 2, column 'a'")


@pytest.mark.parametrize("text", ["1e999", "-1e999", "9" * 400])
def test_not_finite(text):
    with pytest.raises(TableError, match="is not finite"):
        float_cell(text, "here")


@pytest.mark.parametrize(
    ("text", "value"),
    [("1", 1.0), ("+1.", 1.0), ("-.5", -0.5), ("1E-3", 0.001), ("-0", 0.0), ("1e-999", 0.0)],
)
def test_numbers(text, value):
    assert float_cell(text, "here") == value


def test_blank_cells():
    assert float_cell("", "here", blank=7.0) == 7.0
    with pytest.raises(TableError, match="here: the cell is empty"):
        float_cell("", "here")
    with pytest.raises(TableError, match="here: the cell is empty"):
        text_cell("", "here")
    assert text_cell("01", "here") == "01"


def test_flags_are_names():
    assert flag_cell("", "here") == Flag.none
    assert flag_cell("blurred|at_border", "here") == Flag.blurred | Flag.at_border
    with pytest.raises(TableError, match="here: unknown flag 'bad'") as caught:
        flag_cell("bad", "here")
    assert "registry" in caught.value.remedy


def test_two_rows_of_one_name_are_both_named(table):
    read = table("a,b,c\nx,1,\nx,2,\n\nx,1,\n")
    with pytest.raises(TableError, match=r"row 5, column 'a': a 'x', b '1' is also in row 2") as c:
        check_unique(read, ("a", "b"), remedy="remove one")
    assert c.value.remedy == "remove one"


def test_rows_that_differ_in_one_column_of_the_key_are_unique(table):
    read = table("a,b\nx,1\nx,01\n")
    check_unique(read, ("a", "b"), remedy="")
    with pytest.raises(TableError, match="is also in row 2"):
        check_unique(read, ("a", "c"), remedy="")  # a missing column is blank in every row


def test_numbers_do_not_follow_the_locale():
    before = locale.setlocale(locale.LC_NUMERIC)
    for name in ("de_DE.UTF-8", "de_DE.utf8", "fr_FR.UTF-8"):
        try:
            locale.setlocale(locale.LC_NUMERIC, name)
        except locale.Error:
            continue
        break
    try:
        assert float_text(6.35) == "6.35"
        assert float_cell("6.35", "here") == 6.35
    finally:
        locale.setlocale(locale.LC_NUMERIC, before)


def test_nan_is_an_empty_cell():
    assert float_text(math.nan) == ""


@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.floats(allow_nan=False, allow_infinity=False),
            st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=8),
        ),
        min_size=1,
        max_size=5,
    )
)
def test_round_trip(tmp_path, rows):
    write_csv(tmp_path / "t.csv", ["a", "b"], ([float_text(x), text] for x, text in rows))
    read = read_csv(tmp_path / "t.csv", required=["a", "b"])
    assert [math.copysign(1, x) * abs(x) for x in read.floats("a")] == [x for x, _ in rows]
    assert read.texts("b") == [text for _, text in rows]


def test_numpy_numbers_are_written_as_plain_numbers():
    import numpy as np  # noqa: PLC0415

    assert float_text(np.float64(0.1)) == "0.1"
