"""Calibration targets: what is printed on the plate, and where its points lie.

A target's frame has its origin in the middle of the pattern, x to the right, y up and z
towards the viewer. The point in row r, column c is called ``r{r}c{c}``; both count from 0,
row 0 on top.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.features.control import ControlPoints
from closerange.features.pattern import Charuco, Chessboard, DiscGrid, Pattern, refuse_value
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.geometry.transform import RigidTransform

__all__ = ["Charuco", "Chessboard", "DiscGrid", "Pattern", "Target", "control_at"]


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
            raise refuse_value("std_mm", std_mm, "a standard deviation is finite and not negative")
        rows, columns, pitch = _corner_grid(pattern)
        row, column = (part.ravel() for part in np.mgrid[:rows, :columns])
        xyz = np.column_stack(
            [
                (column - (columns - 1) / 2) * pitch[0],
                ((rows - 1) / 2 - row) * pitch[1],
                np.zeros(rows * columns),
            ]
        )
        nothing = np.full(len(xyz), np.nan)
        return cls(
            kind=_KINDS[type(pattern)],
            point=tuple(f"r{r}c{c}" for r, c in zip(row, column, strict=True)),
            xyz_mm=xyz,
            std_mm=np.full(len(xyz), std_mm),
            pattern=pattern,
            diameters_mm=pattern.diameters_mm if isinstance(pattern, DiscGrid) else nothing,
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
