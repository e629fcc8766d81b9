"""Parts whose top faces are known: the truth of heights, and its table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import TableError
from closerange.files import CsvTable, check_unique, read_csv, text_cell
from closerange.geometry.arrays import FloatArray, frozen_array

BOX, DISC = "box", "disc"
SHAPES = (BOX, DISC)

REQUIRED = ("part", "shape", "x_mm", "y_mm", "z_mm", "size_x_mm", "height_mm")
OPTIONAL = ("size_y_mm", "rotation_deg", "placement")


@dataclass(frozen=True, slots=True, eq=False)
class Parts:
    """Parts with a flat top parallel to the XY plane; N rows.

    Attributes
    ----------
    part : tuple of str
        Names; (placement, part) is unique.
    shape : tuple of str
        Outline of the top: ``box`` (a rectangle) or ``disc``.
    top_mm : ndarray, shape (N, 3)
        Middle of the top face in the world.
    size_mm : ndarray, shape (N, 2)
        Sides of the rectangle; of a disc its diameter, twice.
    rotation_rad : ndarray, shape (N,)
        From world X to the first side, towards world Y.
    height_mm : ndarray, shape (N,)
        Top over what the part stands on; negative where world Z points down. Not 0.
    placement : tuple of str
        Where the row holds; blank = in every placement.
    """

    part: tuple[str, ...]
    shape: tuple[str, ...]
    top_mm: FloatArray
    size_mm: FloatArray
    rotation_rad: FloatArray
    height_mm: FloatArray
    placement: tuple[str, ...]

    def __post_init__(self) -> None:
        count = len(self.part)
        for name in ("part", "shape", "placement"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name, tail in (("top_mm", (3,)), ("size_mm", (2,))):
            array = frozen_array(getattr(self, name), (count, *tail), name)
            object.__setattr__(self, name, array)
        for name in ("rotation_rad", "height_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count,), name))
        if len(self.shape) != count or len(self.placement) != count:
            raise ValueError("part, shape and placement differ in length")
        if set(self.shape) - set(SHAPES):
            raise ValueError(f"shapes are {', '.join(SHAPES)}")

    @classmethod
    def of(
        cls,
        part: Sequence[str],
        shape: Sequence[str],
        top_mm: ArrayLike,
        size_mm: ArrayLike,
        *,
        height_mm: ArrayLike,
        rotation_deg: ArrayLike = 0.0,
        placement: str | Sequence[str] = "",
    ) -> Parts:
        """Build from columns; one rotation and one placement may stand for all rows."""
        count = len(part)
        turn = np.broadcast_to(np.deg2rad(np.asarray(rotation_deg, np.float64)), (count,))
        where = (placement,) * count if isinstance(placement, str) else tuple(placement)
        return cls(
            tuple(part),
            tuple(shape),
            np.asarray(top_mm, np.float64),
            np.asarray(size_mm, np.float64),
            turn,
            np.broadcast_to(np.asarray(height_mm, np.float64), (count,)),
            where,
        )

    def __len__(self) -> int:
        return len(self.part)

    @property
    def base_mm(self) -> FloatArray:
        """World Z of what each part stands on, shape (N,)."""
        return np.asarray(self.top_mm[:, 2] - self.height_mm)

    def outside_mm(self, row: int, xy_mm: FloatArray) -> FloatArray:
        """Return how far points lie outside the outline of a top, seen along world Z.

        Parameters
        ----------
        row : int
            Part.
        xy_mm : ndarray, shape (M, 2)
            World X, Y.

        Returns
        -------
        ndarray, shape (M,)
            Distance from the outline in mm; negative inside.
        """
        away = xy_mm - self.top_mm[row, :2]
        if self.shape[row] == DISC:
            return np.asarray(np.hypot(away[:, 0], away[:, 1]) - self.size_mm[row, 0] / 2)
        cos, sin = np.cos(self.rotation_rad[row]), np.sin(self.rotation_rad[row])
        own = away @ np.array([[cos, -sin], [sin, cos]])
        beyond = np.abs(own) - self.size_mm[row] / 2
        outer = np.hypot(*np.maximum(beyond, 0.0).T)
        return np.asarray(np.where((beyond < 0).all(axis=1), beyond.max(axis=1), outer))


def read_parts(path: Path | str) -> Parts:
    """Read a table of parts.

    Parameters
    ----------
    path : Path or str
        CSV file with ``part, shape, x_mm, y_mm, z_mm, size_x_mm, height_mm`` and optionally
        ``size_y_mm`` (needed for a box), ``rotation_deg``, ``placement``.

    Returns
    -------
    Parts
        Its rows.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    names = [text_cell(text, table.where(i, "part")) for i, text in enumerate(table.texts("part"))]
    shapes = [_shape(table, row, text) for row, text in enumerate(table.texts("shape"))]
    check_unique(table, ("placement", "part"), remedy="give each part its own name")
    across = table.floats("size_x_mm")
    along = table.floats("size_y_mm", blank=np.nan)
    for row, shape in enumerate(shapes):
        along[row] = across[row] if shape == DISC and np.isnan(along[row]) else along[row]
        _check_size(table, row, shape, (across[row], along[row]))
    height = table.floats("height_mm")
    for row, value in enumerate(height):
        if value == 0:
            raise TableError(
                f"{table.where(row, 'height_mm')}: a part without a height has no top of its own",
                remedy="write the top's Z minus that of what the part stands on",
            )
    top = np.column_stack([table.floats(f"{axis}_mm") for axis in "xyz"])
    return Parts.of(
        names,
        shapes,
        top,
        np.column_stack([across, along]),
        height_mm=height,
        rotation_deg=table.floats("rotation_deg", blank=0.0),
        placement=table.texts("placement"),
    )


def _shape(table: CsvTable, row: int, text: str) -> str:
    if text not in SHAPES:
        raise TableError(
            f"{table.where(row, 'shape')}: {text!r}", remedy=f"write {' or '.join(SHAPES)}"
        )
    return text


def _check_size(table: CsvTable, row: int, shape: str, size: tuple[float, float]) -> None:
    """Refuse sides that are missing or not above zero, and discs that are not round."""
    for name, value in zip(("size_x_mm", "size_y_mm"), size, strict=True):
        if not value > 0:
            found = "the cell is empty" if np.isnan(value) else f"{value} mm"
            raise TableError(
                f"{table.where(row, name)}: {found}; a top has two sides above 0 mm",
                remedy="write both sides of a box, the diameter of a disc",
            )
    if shape == DISC and size[0] != size[1]:
        raise TableError(
            f"{table.where(row, 'size_y_mm')}: {size[1]} mm for a disc of {size[0]} mm",
            remedy="leave size_y_mm of a disc blank",
        )
