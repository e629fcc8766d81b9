"""What can be printed on a target: grids of discs, chessboards, ChArUco boards.

Rows and columns count from 0, row 0 on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np

from closerange.errors import SchemaError
from closerange.geometry.arrays import FloatArray

POLARITIES = ("white-on-dark", "dark-on-white")
ORIENTATIONS = ("upright", "marks")

MAX_POINTS = 10_000
"""Largest number of points of one target: at 10 px a point they fill a megapixel."""

MIN_MARK_DIFFERENCE = 0.1
"""Least relative difference between a mark disc and an ordinary one: blur, lighting and lens
distortion change apparent diameters by some percent from place to place."""


@dataclass(frozen=True, slots=True)
class DiscGrid:
    """A rectangular grid of discs.

    Attributes
    ----------
    rows, columns : int
        At least 1; a 1 x 1 grid is a single disc.
    pitch_mm : (float, float)
        Distance between neighbouring centres along x and along y, mm.
    disc_diameter_mm : float
        Diameter of an ordinary disc, mm.
    polarity : str
        ``"white-on-dark"`` or ``"dark-on-white"``.
    orientation : str
        ``"upright"``: row 0 is uppermost, column 0 leftmost within 45 degrees of roll.
        ``"marks"``: the mark discs fix it, at any roll. Left blank it becomes ``"marks"``
        where there are mark discs and ``"upright"`` where there are none.
    mark_discs : tuple of (int, int, float)
        Row, column and diameter in mm of the discs that are larger or smaller.

    Raises
    ------
    SchemaError
        If a value is out of its limits; the message names the key and the limit.
    """

    rows: int
    columns: int
    pitch_mm: tuple[float, float]
    disc_diameter_mm: float
    polarity: str = "white-on-dark"
    orientation: str = ""
    mark_discs: tuple[tuple[int, int, float], ...] = ()

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns, least=1, cells=self.rows * self.columns)
        if len(self.pitch_mm) != 2:
            raise refuse_value("pitch_mm", self.pitch_mm, "two numbers: along x and along y")
        for value in self.pitch_mm:
            _check_length("pitch_mm", value)
        _check_length("disc_diameter_mm", self.disc_diameter_mm)
        _check_one_of("polarity", self.polarity, POLARITIES)
        if not self.orientation:
            object.__setattr__(self, "orientation", "marks" if self.mark_discs else "upright")
        _check_one_of("orientation", self.orientation, ORIENTATIONS)
        for mark in self.mark_discs:
            self._check_mark(mark)
        self._check_fit()
        self._check_marks()

    @property
    def diameters_mm(self) -> FloatArray:
        """Diameter of each disc in row-major order, marks included; shape (N,)."""
        diameters = np.full((self.rows, self.columns), float(self.disc_diameter_mm))
        for row, column, diameter in self.mark_discs:
            diameters[row, column] = diameter
        return diameters.ravel()

    @property
    def half_turn_symmetric(self) -> bool:
        """Whether the grid looks the same after a half turn."""
        diameters = self.diameters_mm
        return len(diameters) > 1 and bool(np.array_equal(diameters, diameters[::-1]))

    def _check_mark(self, mark: tuple[int, int, float]) -> None:
        row, column, diameter = mark
        if not (0 <= row < self.rows and 0 <= column < self.columns):
            raise refuse_value(
                "mark_discs", list(mark), f"the grid has {self.rows} rows, {self.columns} columns"
            )
        _check_length("mark_discs", diameter)
        if abs(diameter / self.disc_diameter_mm - 1) < MIN_MARK_DIFFERENCE:
            raise refuse_value(
                "mark_discs",
                list(mark),
                f"a mark differs by at least {MIN_MARK_DIFFERENCE:.0%} from the ordinary "
                f"{self.disc_diameter_mm} mm",
            )

    def _check_fit(self) -> None:
        """Discs must not touch; an axis with a single disc sets no limit."""
        used = [
            pitch
            for pitch, count in zip(self.pitch_mm, (self.columns, self.rows), strict=True)
            if count > 1
        ]
        largest = max([self.disc_diameter_mm, *(mark[2] for mark in self.mark_discs)])
        if used and largest >= min(used):
            key = "disc_diameter_mm" if largest == self.disc_diameter_mm else "mark_discs"
            raise refuse_value(
                key, largest, f"a diameter is smaller than the pitch, here {min(used)} mm"
            )

    def _check_marks(self) -> None:
        """With orientation "marks", no turn of the grid may look like another."""
        places = [mark[:2] for mark in self.mark_discs]
        if len(set(places)) < len(places):
            raise refuse_value("mark_discs", list(self.mark_discs), "each disc is named once")
        if self.orientation != "marks":
            return
        if not self.mark_discs:
            raise refuse_value("orientation", "marks", "mark_discs must say which discs are marks")
        diameters = self.diameters_mm.reshape(self.rows, self.columns)
        turns = (1, 2) if self.rows == self.columns else (2,)
        for turn in turns:
            if np.array_equal(np.rot90(diameters, turn), diameters):
                raise refuse_value(
                    "mark_discs",
                    [list(mark) for mark in self.mark_discs],
                    f"marks must look different after a turn by {90 * turn} degrees",
                )


@dataclass(frozen=True, slots=True)
class Chessboard:
    """A chessboard; its points are the inner corners.

    Where one of `rows` and `columns` is odd and the other even, the square on the upper left
    of corner ``r0c0`` is dark, at any roll. All other boards look the same after a half turn:
    there row 0 is uppermost, column 0 leftmost in the image within 45 degrees of roll.

    Attributes
    ----------
    rows, columns : int
        Inner corners, at least 3.
    square_mm : float
        Side of a square, mm.
    orientation : str
        ``"upright"`` says that a board that looks the same after a half turn is held upright in
        every image; left blank, that is assumed with a warning.

    Raises
    ------
    SchemaError
        If a value is out of its limits.
    """

    rows: int
    columns: int
    square_mm: float
    orientation: str = ""

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns, least=3, cells=self.rows * self.columns)
        _check_length("square_mm", self.square_mm)
        if self.orientation and (self.orientation != "upright" or not self.half_turn_symmetric):
            raise refuse_value(
                "orientation",
                self.orientation,
                "only a board of two odd or two even numbers has one, and it is upright",
            )

    @property
    def half_turn_symmetric(self) -> bool:
        """Whether the board looks the same after a half turn."""
        return (self.rows + self.columns) % 2 == 0


@dataclass(frozen=True, slots=True)
class Charuco:
    """A ChArUco board in OpenCV's layout; its points are the inner corners.

    Attributes
    ----------
    rows, columns : int
        SQUARES, at least 2: there are (rows - 1) x (columns - 1) corners.
    square_mm, marker_mm : float
        Sides of a square and of a marker, mm; the marker is smaller.
    dictionary : str
        OpenCV's name, for instance ``"DICT_4X4_50"``.

    Raises
    ------
    SchemaError
        If a value is out of its limits.
    """

    rows: int
    columns: int
    square_mm: float
    marker_mm: float
    dictionary: str

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns, least=2, cells=self.rows * self.columns)
        _check_length("square_mm", self.square_mm)
        _check_length("marker_mm", self.marker_mm)
        if self.marker_mm >= self.square_mm:
            raise refuse_value(
                "marker_mm", self.marker_mm, f"smaller than the square, {self.square_mm} mm"
            )
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        _check_one_of("dictionary", self.dictionary, known)
        size = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        needed = self.rows * self.columns // 2
        if needed > size:
            raise refuse_value(
                "dictionary", self.dictionary, f"it has {size} markers, the board needs {needed}"
            )


Pattern: TypeAlias = DiscGrid | Chessboard | Charuco


def refuse_value(key: str, value: Any, limit: str) -> SchemaError:
    """Build the error of a key whose value breaks a limit."""
    return SchemaError(f"{key} = {value!r}; {limit}", remedy=f"correct {key}")


def _check_counts(rows: int, columns: int, *, least: int, cells: int) -> None:
    for key, value in (("rows", rows), ("columns", columns)):
        if value < least:
            raise refuse_value(key, value, f"at least {least}")
    if cells > MAX_POINTS:
        raise refuse_value("rows", rows, f"with {columns} columns more than {MAX_POINTS} points")


def _check_length(key: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise refuse_value(key, value, "a length in mm is finite and larger than 0")


def _check_one_of(key: str, value: str, known: tuple[str, ...] | list[str]) -> None:
    if value not in known:
        raise refuse_value(key, value, f"one of {', '.join(known)}")
