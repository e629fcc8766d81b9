"""Reading the thesis' tables, writing Markdown, comparing two pages."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.files import CsvTable, read_csv

FloatArray = NDArray[np.float64]
Lines = list[str]

DATA = Path(__file__).parents[2] / "data" / "thesis"
RUNS = {18: "fig_2_5_2_6_n18.csv", 27: "fig_2_7_2_8_n27.csv", 54: "fig_2_9_2_10_n54.csv"}
AXES = ("X", "Y", "Z")

_NUMBER = re.compile(r"[-+]?\d+(?:\.(\d+))?")


def read_table(name: str, required: Sequence[str], optional: Sequence[str] = ()) -> CsvTable:
    """Read a CSV table of data/thesis with all its columns named."""
    return read_csv(DATA / name, required=required, optional=optional)


def read_json(name: str) -> Any:
    """Read a JSON file of data/thesis."""
    return json.loads((DATA / name).read_text(encoding="utf-8"))


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Lines:
    """Write a Markdown table; every column but the first is set flush right."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return ["", *("| " + " | ".join(cells) + " |" for cells in (header, rule, *rows)), ""]


def fixed(value: float, decimals: int) -> str:
    """Write a number with fixed decimals; n/a for NaN, no minus before zero."""
    if not np.isfinite(value):
        return "n/a"
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if not float(text) else text


def differences(page: str, other: str, *, share: float = 0.0) -> Lines:
    """Compare two pages: words exactly, numbers within a tolerance.

    Parameters
    ----------
    page, other : str
        Markdown.
    share : float
        Tolerance as a share of the number; one unit of the last printed decimal is always
        allowed, since platforms round differently there.

    Returns
    -------
    list of str
        One line for each line that differs; empty if the pages agree.
    """
    found = []
    left, right = page.splitlines(), other.splitlines()
    if len(left) != len(right):
        found.append(f"{len(left)} lines against {len(right)}")
    for number, (a, b) in enumerate(zip(left, right, strict=False), start=1):
        if not _agree(a, b, share):
            found.append(f"line {number}: {a!r} against {b!r}")
    return found


def _agree(a: str, b: str, share: float) -> bool:
    """Tell whether two lines have the same words and nearly the same numbers."""
    if a == b:
        return True
    if _NUMBER.sub("#", a) != _NUMBER.sub("#", b):
        return False
    for left, right in zip(_NUMBER.finditer(a), _NUMBER.finditer(b), strict=True):
        decimals = len(left.group(1) or "")
        if decimals != len(right.group(1) or ""):
            return False
        x, y = float(left.group()), float(right.group())
        if abs(x - y) > max(1.01 * 10.0**-decimals, share * abs(x)):
            return False
    return True
