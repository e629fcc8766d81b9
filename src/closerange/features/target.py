"""Calibration targets: what is printed on the plate, and where its points lie.

A target's frame has its origin in the middle of the pattern, x to the right, y up and z
towards the viewer. The point in row r, column c is called ``r{r}c{c}``; both count from 0,
row 0 on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError, SchemaError
from closerange.features.control import ControlPoints
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.geometry.transform import RigidTransform

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
            raise _refuse("pitch_mm", self.pitch_mm, "two numbers: along x and along y")
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

    def _check_mark(self, mark: tuple[int, int, float]) -> None:
        row, column, diameter = mark
        if not (0 <= row < self.rows and 0 <= column < self.columns):
            raise _refuse(
                "mark_discs", list(mark), f"the grid has {self.rows} rows, {self.columns} columns"
            )
        _check_length("mark_discs", diameter)
        if abs(diameter / self.disc_diameter_mm - 1) < MIN_MARK_DIFFERENCE:
            raise _refuse(
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
            raise _refuse(
                key, largest, f"a diameter is smaller than the pitch, here {min(used)} mm"
            )

    def _check_marks(self) -> None:
        """With orientation "marks", no turn of the grid may look like another."""
        places = [mark[:2] for mark in self.mark_discs]
        if len(set(places)) < len(places):
            raise _refuse("mark_discs", list(self.mark_discs), "each disc is named once")
        if self.orientation != "marks":
            return
        if not self.mark_discs:
            raise _refuse("orientation", "marks", "mark_discs must say which discs are marks")
        diameters = self.diameters_mm.reshape(self.rows, self.columns)
        turns = (1, 2) if self.rows == self.columns else (2,)
        for turn in turns:
            if np.array_equal(np.rot90(diameters, turn), diameters):
                raise _refuse(
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

    Raises
    ------
    SchemaError
        If a value is out of its limits.
    """

    rows: int
    columns: int
    square_mm: float

    def __post_init__(self) -> None:
        _check_counts(self.rows, self.columns, least=3, cells=self.rows * self.columns)
        _check_length("square_mm", self.square_mm)

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
            raise _refuse(
                "marker_mm", self.marker_mm, f"smaller than the square, {self.square_mm} mm"
            )
        known = sorted(name for name in dir(cv2.aruco) if name.startswith("DICT_"))
        _check_one_of("dictionary", self.dictionary, known)
        size = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        needed = self.rows * self.columns // 2
        if needed > size:
            raise _refuse(
                "dictionary", self.dictionary, f"it has {size} markers, the board needs {needed}"
            )


Pattern: TypeAlias = DiscGrid | Chessboard | Charuco


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """Points on a rigid body and the pattern by which they are found; N points.

    Attributes
    ----------
    kind : str
        ``"disc-grid"``, ``"chessboard"``, ``"charuco"`` or ``"points"``.
    point : tuple of str
        Names; of a pattern, ``r{r}c{c}`` in row-major order.
    xyz_mm : ndarray, shape (N, 3)
        Position in the target's frame, mm.
    std_mm : ndarray, shape (N,)
        Standard deviation of each coordinate, mm; 0 = exact.
    pattern : DiscGrid, Chessboard, Charuco or None
        None for points without a pattern.
    diameters_mm : ndarray, shape (N,)
        True diameters of discs, marks included; NaN for other features.
    """

    kind: str
    point: tuple[str, ...]
    xyz_mm: FloatArray
    std_mm: FloatArray
    pattern: Pattern | None
    diameters_mm: FloatArray

    def __post_init__(self) -> None:
        count = len(self.point)
        object.__setattr__(self, "xyz_mm", frozen_array(self.xyz_mm, (count, 3), "xyz_mm"))
        object.__setattr__(self, "std_mm", frozen_array(self.std_mm, (count,), "std_mm"))
        object.__setattr__(
            self, "diameters_mm", frozen_array(self.diameters_mm, (count,), "diameters_mm")
        )

    @classmethod
    def of(cls, pattern: Pattern, *, std_mm: float = 0.0) -> Target:
        """Lay out the points of a pattern.

        Parameters
        ----------
        pattern : DiscGrid, Chessboard or Charuco
            What is printed.
        std_mm : float, optional
            How well the target was made: standard deviation of each coordinate, mm.

        Returns
        -------
        Target
            Points in row-major order, z = 0.

        Raises
        ------
        SchemaError
            If `std_mm` is negative or not finite.
        """
        if not (math.isfinite(std_mm) and std_mm >= 0):
            raise _refuse("std_mm", std_mm, "a standard deviation is finite and not negative")
        rows, columns, pitch = _corner_grid(pattern)
        row, column = (part.ravel() for part in np.mgrid[:rows, :columns])
        xyz = np.column_stack(
            [
                (column - (columns - 1) / 2) * pitch[0],
                ((rows - 1) / 2 - row) * pitch[1],
                np.zeros(rows * columns),
            ]
        )
        discs = isinstance(pattern, DiscGrid)
        return cls(
            kind=_KINDS[type(pattern)],
            point=tuple(f"r{r}c{c}" for r, c in zip(row, column, strict=True)),
            xyz_mm=xyz,
            std_mm=np.full(len(xyz), std_mm),
            pattern=pattern,
            diameters_mm=pattern.diameters_mm if discs else np.full(len(xyz), np.nan),
        )

    @classmethod
    def of_points(
        cls, point: tuple[str, ...], xyz_mm: ArrayLike, *, std_mm: ArrayLike = 0.0
    ) -> Target:
        """Build a target of kind "points", which has no pattern.

        Parameters
        ----------
        point : tuple of str
            Names, each once.
        xyz_mm : array_like, shape (N, 3)
            Positions in the target's frame, mm.
        std_mm : array_like, optional
            One value for all points, or one a point.

        Returns
        -------
        Target
            N points.

        Raises
        ------
        InputError
            If a name appears twice.
        """
        if len(set(point)) < len(point):
            twice = next(name for name in point if point.count(name) > 1)
            raise InputError(f"point {twice!r} appears twice", remedy="remove one of the two")
        return cls(
            kind="points",
            point=tuple(point),
            xyz_mm=np.asarray(xyz_mm, dtype=np.float64),
            std_mm=np.broadcast_to(np.asarray(std_mm, dtype=np.float64), (len(point),)),
            pattern=None,
            diameters_mm=np.full(len(point), np.nan),
        )

    def __len__(self) -> int:
        return len(self.point)


_KINDS: dict[type, str] = {DiscGrid: "disc-grid", Chessboard: "chessboard", Charuco: "charuco"}


def control_at(
    target: Target,
    *,
    z_mm: float | None = None,
    world_from_target: RigidTransform | None = None,
    placement: str = "",
) -> ControlPoints:
    """Give the world positions of a target's points in one placement.

    Parameters
    ----------
    target : Target
        The target.
    z_mm : float, optional
        Height of a plate that lies parallel to the world's XY plane with its axes along the
        world's and its middle on the world's Z axis, mm.
    world_from_target : RigidTransform, optional
        Where the target is otherwise. Exactly one of the two is given.
    placement : str, optional
        Name of the placement; blank holds for every placement.

    Returns
    -------
    ControlPoints
        N rows in the target's order.

    Raises
    ------
    InputError
        If not exactly one of `z_mm` and `world_from_target` is given, or `z_mm` is not finite.
    """
    if (z_mm is None) == (world_from_target is None):
        raise InputError(
            "the place of the target needs exactly one of z_mm and world_from_target",
            remedy="give the height of a plate parallel to the XY plane, or a rigid transform",
        )
    if world_from_target is None:
        if z_mm is None or not math.isfinite(z_mm):
            raise InputError(f"z_mm = {z_mm}; expected a finite number", remedy="correct it")
        world_from_target = RigidTransform(np.eye(3), np.array([0.0, 0.0, z_mm]))
    return ControlPoints.of(
        target.point,
        world_from_target.apply(target.xyz_mm),
        placement=placement,
        std_mm=target.std_mm,
    )


def _corner_grid(pattern: Pattern) -> tuple[int, int, tuple[float, float]]:
    """Return rows, columns and pitch of the points of a pattern."""
    if isinstance(pattern, DiscGrid):
        return pattern.rows, pattern.columns, pattern.pitch_mm
    pitch = (pattern.square_mm, pattern.square_mm)
    if isinstance(pattern, Charuco):
        return pattern.rows - 1, pattern.columns - 1, pitch
    return pattern.rows, pattern.columns, pitch


def _refuse(key: str, value: Any, limit: str) -> SchemaError:
    return SchemaError(f"{key} = {value!r}; {limit}", remedy=f"correct {key}")


def _check_counts(rows: int, columns: int, *, least: int, cells: int) -> None:
    for key, value in (("rows", rows), ("columns", columns)):
        if value < least:
            raise _refuse(key, value, f"at least {least}")
    if cells > MAX_POINTS:
        raise _refuse("rows", rows, f"with {columns} columns more than {MAX_POINTS} points")


def _check_length(key: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise _refuse(key, value, "a length in mm is finite and larger than 0")


def _check_one_of(key: str, value: str, known: tuple[str, ...] | list[str]) -> None:
    if value not in known:
        raise _refuse(key, value, f"one of {', '.join(known)}")
