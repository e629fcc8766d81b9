"""Points at known world positions: the control table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError, TableError
from closerange.features.image_points import ImagePoints
from closerange.files import check_unique, float_text, read_csv, text_cell, write_csv
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array

REQUIRED = ("point", "x_mm", "y_mm", "z_mm")
OPTIONAL = ("placement", "std_mm", "role")
ROLES = ("", "calibration", "check")


@dataclass(frozen=True, slots=True, eq=False)
class ControlPoints:
    """Known positions, optionally different in each placement; N rows.

    Attributes
    ----------
    placement, point : tuple of str
        Names; a blank placement holds for every placement that has no row of its own.
    xyz_mm : ndarray, shape (N, 3)
        World position in mm.
    std_mm : ndarray, shape (N,)
        Standard deviation of each coordinate in mm; 0 = exact.
    check : ndarray of bool, shape (N,)
        Points that are kept out of the calibration and used to check it (``role = check``).

    Raises
    ------
    InputError
        If a position is not finite, or a standard deviation is none.
    """

    placement: tuple[str, ...]
    point: tuple[str, ...]
    xyz_mm: FloatArray
    std_mm: FloatArray
    check: NDArray[np.bool_]

    def __post_init__(self) -> None:
        count = len(self.point)
        object.__setattr__(self, "xyz_mm", frozen_array(self.xyz_mm, (count, 3), "xyz_mm"))
        object.__setattr__(self, "std_mm", frozen_array(self.std_mm, (count,), "std_mm"))
        check = np.array(self.check, dtype=np.bool_)
        if check.shape != (count,) or len(self.placement) != count:
            raise ValueError("placement, point, xyz_mm, std_mm and check differ in length")
        check.flags.writeable = False
        object.__setattr__(self, "check", check)
        self._require_numbers()

    def _require_numbers(self) -> None:
        """Refuse positions that are not known, and what is no standard deviation."""
        for row in np.flatnonzero(~np.isfinite(self.xyz_mm).all(axis=1)):
            x, y, z = self.xyz_mm[row]
            raise InputError(
                f"control {self._name(int(row))}: its position ({x:g}, {y:g}, {z:g}) mm is unknown",
                remedy="leave the point out, or give three finite numbers",
            )
        for row in np.flatnonzero(~((self.std_mm >= 0) & np.isfinite(self.std_mm))):
            raise InputError(
                f"control {self._name(int(row))}: {self.std_mm[row]:g} mm is no standard deviation",
                remedy="give a finite number that is not negative; 0 for exact points",
            )

    def _name(self, row: int) -> str:
        placement = f" of placement {self.placement[row]!r}" if self.placement[row] else ""
        return f"point {self.point[row]!r}{placement}"

    @classmethod
    def of(
        cls,
        point: Sequence[str],
        xyz_mm: ArrayLike,
        *,
        placement: str | Sequence[str] = "",
        std_mm: ArrayLike = 0.0,
        check: ArrayLike = False,
    ) -> ControlPoints:
        """Build from points at known positions.

        Parameters
        ----------
        point : sequence of str
            Names.
        xyz_mm : array_like, shape (N, 3)
            World positions in mm.
        placement : str or sequence of str, optional
            One name for all rows, or one a row.
        std_mm, check : array_like, optional
            One value for all rows, or one a row.

        Returns
        -------
        ControlPoints
            N rows.
        """
        count = len(point)
        placements = (placement,) * count if isinstance(placement, str) else tuple(placement)
        return cls(
            placement=placements,
            point=tuple(point),
            xyz_mm=np.asarray(xyz_mm, dtype=np.float64),
            std_mm=np.broadcast_to(np.asarray(std_mm, dtype=np.float64), (count,)),
            check=np.broadcast_to(np.asarray(check, dtype=np.bool_), (count,)),
        )

    def __len__(self) -> int:
        return len(self.point)

    def rows_for(self, placement: Sequence[str], point: Sequence[str]) -> IntArray:
        """Find the row that holds for each (placement, point).

        Parameters
        ----------
        placement, point : sequence of str
            Names, one pair a query.

        Returns
        -------
        ndarray of int
            Row index, -1 where the point is not known. A row of the same placement wins over
            one with a blank placement.
        """
        index = {key: row for row, key in enumerate(zip(self.placement, self.point, strict=True))}
        return np.array(
            [
                index.get((a, b), index.get(("", b), -1))
                for a, b in zip(placement, point, strict=True)
            ],
            dtype=np.int64,
        )

    def rows_of(self, points: ImagePoints) -> IntArray:
        """Find the row that holds for each image point; see `rows_for`."""
        return self.rows_for(points.placement, points.point)


def read_control(path: Path | str) -> ControlPoints:
    """Read a control table.

    Parameters
    ----------
    path : Path or str
        CSV file with ``point, x_mm, y_mm, z_mm`` and optionally ``placement, std_mm, role``.

    Returns
    -------
    ControlPoints
        Its rows.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    point = [text_cell(t, table.where(i, "point")) for i, t in enumerate(table.texts("point"))]
    check_unique(table, ("point", "placement"), remedy="remove one of the two rows")
    std = table.floats("std_mm", blank=0.0)
    for row, value in enumerate(std):
        if value < 0:
            raise TableError(
                f"{table.where(row, 'std_mm')}: {value} mm; a standard deviation is not negative",
                remedy="write its magnitude, or leave the cell blank for exact points",
            )
    roles = table.texts("role")
    for row, role in enumerate(roles):
        if role not in ROLES:
            raise TableError(
                f"{table.where(row, 'role')}: {role!r}; known roles are calibration and check",
                remedy="leave the cell blank for calibration",
            )
    return ControlPoints.of(
        point,
        np.column_stack([table.floats(name) for name in ("x_mm", "y_mm", "z_mm")]),
        placement=table.texts("placement"),
        std_mm=std,
        check=[role == "check" for role in roles],
    )


def write_control(control: ControlPoints, path: Path | str) -> None:
    """Write a control table.

    Parameters
    ----------
    control : ControlPoints
        Rows.
    path : Path or str
        CSV file, replaced whole or not at all.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    xyz = control.xyz_mm
    write_csv(
        path,
        ["placement", "point", "x_mm", "y_mm", "z_mm", "std_mm", "role"],
        (
            [
                control.placement[i],
                control.point[i],
                *(float_text(value) for value in xyz[i]),
                float_text(control.std_mm[i]),
                "check" if control.check[i] else "calibration",
            ]
            for i in range(len(control))
        ),
    )
