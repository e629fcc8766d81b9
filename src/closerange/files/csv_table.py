"""The CSV dialect of all tables: UTF-8, header, columns by name, decimal points, empty = NaN."""

from __future__ import annotations

import csv
import io
import math
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from closerange.errors import CloseRangeWarning, TableError
from closerange.files.atomic import write_text
from closerange.files.limited import MAX_TABLE_BYTES, read_text
from closerange.flags import Flag, parse_flags

# float() would also take "nan", "inf", "1_000" and blanks inside other alphabets' digits
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """Cells of a CSV file, by column name.

    Attributes
    ----------
    source : str
        File name for error messages.
    columns : dict of str to list of str
        Cells as texts, stripped of outer blanks.
    line : list of int
        Line of the file on which each row begins, from 1.
    """

    source: str
    columns: dict[str, list[str]]
    line: list[int]

    def __len__(self) -> int:
        return len(self.line)

    def where(self, row: int, column: str) -> str:
        """Name a cell as ``file, row N, column 'x'`` for messages."""
        return f"{self.source}, row {self.line[row]}, column {column!r}"

    def texts(self, column: str) -> list[str]:
        """Return a column as texts; blanks if the table does not have it."""
        return self.columns.get(column) or [""] * len(self)

    def floats(self, column: str, *, blank: float | None = None) -> list[float]:
        """Return a column as finite numbers.

        Parameters
        ----------
        column : str
            Its name; a missing column counts as blank cells.
        blank : float, optional
            What an empty cell means; without it an empty cell is an error.

        Returns
        -------
        list of float
            One number a row.

        Raises
        ------
        TableError
            If a cell is not a finite number with a decimal point.
        """
        return [
            float_cell(text, self.where(row, column), blank=blank)
            for row, text in enumerate(self.texts(column))
        ]


def read_csv(
    path: Path | str, *, required: Sequence[str], optional: Sequence[str] = ()
) -> CsvTable:
    """Read a table whose columns are found by name, in any order.

    Parameters
    ----------
    path : Path or str
        The file.
    required, optional : sequence of str
        Column names. Unknown columns are reported in one warning and left out.

    Returns
    -------
    CsvTable
        At least one row.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a column is missing or doubled, a row has another number of cells than the header,
        or there is no row.
    """
    source = str(path)
    rows = _rows(read_text(path, MAX_TABLE_BYTES), source)
    _, header = rows[0]
    _check_header(header, required, source, set(required) | set(optional))
    body = rows[1:]
    for line, cells in body:
        if len(cells) != len(header):
            raise TableError(
                f"{source}, row {line}: {len(cells)} cells, the header has {len(header)}",
                remedy="a decimal comma or a stray separator splits cells: use decimal points",
            )
    if not body:
        raise TableError(f"{source}: a header without rows", remedy="write at least one row")
    wanted = [name for name in (*required, *optional) if name in header]
    columns = {name: [cells[header.index(name)] for _, cells in body] for name in wanted}
    return CsvTable(source, columns, [line for line, _ in body])


def write_csv(path: Path | str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Write a table, atomically.

    Parameters
    ----------
    path : Path or str
        The file.
    header : sequence of str
        Column names.
    rows : iterable of sequence of str
        Cells as texts; see `float_text`.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_text(path, stream.getvalue())


def float_text(value: float) -> str:
    """Write a number so that it round-trips exactly; NaN becomes an empty cell."""
    return "" if math.isnan(value) else repr(float(value))


def float_cell(text: str, where: str, *, blank: float | None = None) -> float:
    """Read one cell as a finite number, whatever the locale.

    Parameters
    ----------
    text : str
        The cell.
    where : str
        File, row and column for the message.
    blank : float, optional
        What an empty cell means; without it an empty cell is an error.

    Returns
    -------
    float
        The number.

    Raises
    ------
    TableError
        If it is not a finite number with a decimal point.
    """
    if not text and blank is not None:
        return blank
    if not text:
        raise TableError(f"{where}: the cell is empty", remedy="write a number")
    if not _NUMBER.fullmatch(text):
        comma = "," in text and _NUMBER.fullmatch(text.replace(",", "."))
        remedy = "write a decimal point, not a comma" if comma else "write a finite number"
        raise TableError(f"{where}: {text!r} is not a number", remedy=remedy)
    value = float(text)
    if not math.isfinite(value):
        raise TableError(f"{where}: {text!r} is not finite", remedy="write a finite number")
    return value


def text_cell(text: str, where: str) -> str:
    """Read one cell as an opaque, non-empty text.

    Parameters
    ----------
    text : str
        The cell.
    where : str
        File, row and column for the message.

    Returns
    -------
    str
        The same text.

    Raises
    ------
    TableError
        If it is empty.
    """
    if not text:
        raise TableError(f"{where}: the cell is empty", remedy="write a name")
    return text


def flag_cell(text: str, where: str) -> Flag:
    """Read one cell as quality bits.

    Parameters
    ----------
    text : str
        Names joined by ``|``; empty when nothing is wrong.
    where : str
        File, row and column for the message.

    Returns
    -------
    Flag
        The combined bits.

    Raises
    ------
    TableError
        If a name is not in the registry.
    """
    try:
        return parse_flags(text)
    except ValueError as error:
        raise TableError(
            f"{where}: {error}", remedy="use names of the registry, joined by |"
        ) from error


def check_unique(table: CsvTable, key: Sequence[str], *, remedy: str) -> None:
    """Refuse a table that has two rows of one name.

    Parameters
    ----------
    table : CsvTable
        The table.
    key : sequence of str
        Columns that name a row together; the first is blamed.
    remedy : str
        What to do about it.

    Raises
    ------
    TableError
        If two rows agree in all of `key`; it names both.
    """
    seen: dict[tuple[str, ...], int] = {}
    for row, cells in enumerate(zip(*(table.texts(name) for name in key), strict=True)):
        if cells in seen:
            named = ", ".join(f"{name} {cell!r}" for name, cell in zip(key, cells, strict=True))
            raise TableError(
                f"{table.where(row, key[0])}: {named} is also in row {table.line[seen[cells]]}",
                remedy=remedy,
            )
        seen[cells] = row


def _rows(text: str, source: str) -> list[tuple[int, list[str]]]:
    """Split a file into (line, cells), leaving out blank lines."""
    if "\0" in text:
        raise TableError(f"{source}: contains NUL bytes; not a text table", remedy="save it as CSV")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[tuple[int, list[str]]] = []
    line = 1
    try:
        for cells in reader:
            if any(cell.strip() for cell in cells):
                rows.append((line, [cell.strip() for cell in cells]))
            line = reader.line_num + 1
    except csv.Error as error:
        raise TableError(f"{source}, row {line}: {error}", remedy="correct the quoting") from error
    if not rows:
        raise TableError(f"{source}: no header", remedy="write a header line with the column names")
    return rows


def _check_header(header: list[str], required: Sequence[str], source: str, known: set[str]) -> None:
    """Refuse missing and doubled columns; report unknown ones once."""
    doubled = sorted({name for name in header if header.count(name) > 1})
    if doubled:
        raise TableError(
            f"{source}: column {doubled[0]!r} appears twice", remedy="remove one of them"
        )
    missing = [name for name in required if name not in header]
    if missing:
        semicolons = len(header) == 1 and ";" in header[0]
        raise TableError(
            f"{source}: column {missing[0]!r} is missing; found {', '.join(header)}",
            remedy="separate cells by commas, not semicolons"
            if semicolons
            else f"the header needs {', '.join(required)}; units belong to the names",
        )
    unknown = [name for name in header if name not in known]
    if unknown:
        warnings.warn(
            f"{source}: unknown columns ignored: {', '.join(unknown)}",
            CloseRangeWarning,
            stacklevel=4,
        )
