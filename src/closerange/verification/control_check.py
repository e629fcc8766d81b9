"""Measured positions against the control points' known ones (figures 2.5 to 2.10)."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import DataError
from closerange.features.control import ControlPoints
from closerange.flags import Flag, format_flags
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.position.positions import Positions
from closerange.verification.result_file import plain
from closerange.verification.standing import hollow_text, without_reading
from closerange.verification.statistics import (
    AXES,
    Coverage,
    ErrorSummary,
    region_coverage,
    summarise_errors,
)

TOLERATED = int(Flag.outside_volume | Flag.untrusted)
"""Flags that say where or with what a row was measured, not that the row is bad: averaged."""

_ROWS = (
    "placement",
    "reading",
    "point",
    "role",
    "inside",
    "used",
    "original_mm",
    "calculated_mm",
    "error_mm",
    "flags",
)

FITTED, CHECK, UNKNOWN = "fitted", "check", "unknown"


@dataclass(frozen=True, slots=True, eq=False)
class Systematic:
    """Errors that repeat for the same point in different placements; K points.

    Attributes
    ----------
    point : tuple of str
        Points that were measured in at least two placements.
    count : ndarray of int, shape (K,)
        Rows of each.
    mean_mm, std_mm : ndarray, shape (K, 3)
        Mean error of each and its scatter about that mean.
    repeated_share : ndarray, shape (3,)
        Share of the sum of squared errors that the means account for.
    chance_share : float
        Share that purely random errors would show: points / rows.
    rms_mm, rms_without_mm : ndarray, shape (3,)
        RMS of the errors before and after the means are removed.
    """

    point: tuple[str, ...]
    count: IntArray
    mean_mm: FloatArray
    std_mm: FloatArray
    repeated_share: FloatArray
    chance_share: float
    rms_mm: FloatArray
    rms_without_mm: FloatArray

    def __post_init__(self) -> None:
        points = len(self.point)
        object.__setattr__(self, "count", frozen_ints(self.count, (points,), "count"))
        for name in ("mean_mm", "std_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (points, 3), name))
        for name in ("repeated_share", "rms_mm", "rms_without_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (3,), name))


@dataclass(frozen=True, slots=True, eq=False)
class ControlCheck:
    """Comparison with control points; N rows that have a truth.

    Attributes
    ----------
    placement, reading, point : tuple of str
        Names.
    role : tuple of str
        ``fitted`` (took part in the calibration), ``check`` or ``unknown``.
    inside : ndarray of bool, shape (N,)
        Original position within the calibrated block; True if no block was given.
    used : ndarray of bool, shape (N,)
        Took part in the averages: measured and without a flag (other than `outside_volume` and
        `untrusted`, which condemn no row).
    original_mm, calculated_mm, error_mm : ndarray, shape (N, 3)
        Known, measured, and calculated minus original.
    flags : ndarray of int, shape (N,)
        `Flag` bits.
    groups : dict of str to ErrorSummary
        ``all`` used rows; ``fitted`` and ``check`` if known; ``inside`` and ``outside`` if a
        block was given.
    coverage : dict of str to Coverage
        95 % regions of the same groups. Fitted points take part in their own prediction: only
        check points prove it.
    systematic : Systematic
        Per-point errors that repeat.
    missing : tuple of (str, str, str)
        (placement, reading, point) that have no truth.
    left_out : tuple of (str, str, str, str)
        (placement, reading, point, flags) of rows not used.
    not_measured : tuple of (str, str)
        (placement, point) of truths without any measured row.
    """

    placement: tuple[str, ...]
    reading: tuple[str, ...]
    point: tuple[str, ...]
    role: tuple[str, ...]
    inside: NDArray[np.bool_]
    used: NDArray[np.bool_]
    original_mm: FloatArray
    calculated_mm: FloatArray
    error_mm: FloatArray
    flags: IntArray
    groups: dict[str, ErrorSummary]
    coverage: dict[str, Coverage]
    systematic: Systematic
    missing: tuple[tuple[str, str, str], ...] = ()
    left_out: tuple[tuple[str, str, str, str], ...] = ()
    not_measured: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        rows = len(self.point)
        for name in ("original_mm", "calculated_mm", "error_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (rows, 3), name))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (rows,), "flags"))
        for name in ("inside", "used"):
            mask = np.array(getattr(self, name), dtype=np.bool_)
            mask.flags.writeable = False
            object.__setattr__(self, name, mask)

    def __len__(self) -> int:
        return len(self.point)

    @property
    def hollow(self) -> str:
        """Why the averages stand on too few rows; empty where most were used."""
        return hollow_text(len(self.left_out), len(self), "rows with a true position")

    def __str__(self) -> str:
        texts = []
        for name, group in self.groups.items():
            x, y, z, space = 1000 * group.mean_abs_mm
            texts.append(
                f"{name} ({group.count}): mean abs error {x:.3g} um (X) {y:.3g} um (Y) "
                f"{z:.3g} um (Z) {space:.3g} um (3-D)"
            )
        return "\n".join(texts)

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document; null = not known."""
        document = plain(self)
        rows = {name: document.pop(name) for name in _ROWS}
        rows["flags"] = [format_flags(int(flag)) for flag in self.flags]
        signs = {"axes": list(AXES), "error_sign": "calculated minus original"}
        return {"kind": "control", **signs, "rows": rows, **document}


def compare_with_control(
    positions: Positions,
    control: ControlPoints,
    *,
    fitted: Collection[tuple[str, str]] | None = None,
    volume_mm: ArrayLike | None = None,
) -> ControlCheck:
    """Compare measured positions with control points.

    Parameters
    ----------
    positions : Positions
        Measured.
    control : ControlPoints
        Known positions, taken as exact in the averages; their `std_mm` is added to the
        predicted covariances.
    fitted : collection of (str, str), optional
        (placement, point) that took part in the calibration; all others are check points.
        Without it the control table's `check` decides, if it marks any.
    volume_mm : array_like, shape (2, 3), optional
        Calibrated block; rows inside and outside are averaged apart.

    Returns
    -------
    ControlCheck
        Tables and averages as in figures (2.5) to (2.10).

    Raises
    ------
    DataError
        If no position has a truth.
    """
    truth = control.rows_for(positions.placement, positions.point)
    known = truth >= 0
    if not known.any():
        raise DataError(
            f"none of {len(positions)} positions is among the {len(control)} control points",
            remedy="use the same names of placements and points in both tables",
        )
    rows = positions.select(known)
    truth = truth[known]
    original = control.xyz_mm[truth]
    inside = _inside(original, volume_mm)
    role = _roles(rows, control.check[truth], fitted, any_check=bool(control.check.any()))
    used = usable(rows)
    error = rows.xyz_mm - original
    members = _members(used, role, inside, with_volume=volume_mm is not None)
    cov = rows.cov_mm2 + control.std_mm[truth, None, None] ** 2 * np.eye(3)
    return ControlCheck(
        placement=rows.placement,
        reading=rows.reading,
        point=rows.point,
        role=role,
        inside=inside,
        used=used,
        original_mm=original,
        calculated_mm=rows.xyz_mm,
        error_mm=error,
        flags=rows.flags,
        groups={name: summarise_errors(error[mask]) for name, mask in members.items()},
        coverage={
            name: region_coverage(error[mask], cov[mask], dof=rows.dof)
            for name, mask in members.items()
        },
        systematic=systematic_errors(rows.select(used), error[used]),
        missing=tuple(key for key, has in zip(positions.keys(), known, strict=True) if not has),
        left_out=left_out_rows(rows, used),
        not_measured=without_reading(rows, rows.measured, control),
    )


def usable(positions: Positions) -> NDArray[np.bool_]:
    """Tell which rows take part in averages: measured, and flagged for nothing but `TOLERATED`."""
    mask: NDArray[np.bool_] = positions.measured & (positions.flags & ~TOLERATED == 0)
    return mask


def left_out_rows(
    positions: Positions, used: NDArray[np.bool_]
) -> tuple[tuple[str, str, str, str], ...]:
    """List (placement, reading, point, flags) of the rows that are not used."""
    return tuple(
        (*key, format_flags(int(flag)))
        for key, flag, use in zip(positions.keys(), positions.flags, used, strict=True)
        if not use
    )


def systematic_errors(rows: Positions, error_mm: FloatArray) -> Systematic:
    """Find errors that repeat for the same point over placements.

    Parameters
    ----------
    rows : Positions
        N measured rows.
    error_mm : ndarray, shape (N, 3)
        Their errors.

    Returns
    -------
    Systematic
        Of points in at least two placements; empty if there is none.
    """
    placements: dict[str, set[str]] = {}
    for placement, point in zip(rows.placement, rows.point, strict=True):
        placements.setdefault(point, set()).add(placement)
    points = tuple(point for point, found in placements.items() if len(found) > 1)
    nothing = np.full(3, np.nan)
    if not points:
        empty = np.empty((0, 3))
        return Systematic(
            (), np.empty(0, np.int64), empty, empty, nothing, np.nan, nothing, nothing
        )
    number = {point: i for i, point in enumerate(points)}
    repeated = np.array([point in number for point in rows.point])
    error = error_mm[repeated]
    group = np.array([number[point] for point in rows.point if point in number])
    count = np.bincount(group)
    mean = np.zeros((len(points), 3))
    np.add.at(mean, group, error)
    mean /= count[:, None]
    rest = error - mean[group]
    scatter = np.zeros_like(mean)
    np.add.at(scatter, group, rest**2)
    rms, rms_without = (np.sqrt((value**2).mean(axis=0)) for value in (error, rest))
    with np.errstate(invalid="ignore", divide="ignore"):
        share = 1 - (rms_without / rms) ** 2
    return Systematic(
        point=points,
        count=count,
        mean_mm=mean,
        std_mm=np.sqrt(scatter / (count - 1)[:, None]),
        repeated_share=share,
        chance_share=len(points) / len(error),
        rms_mm=rms,
        rms_without_mm=rms_without,
    )


def _roles(
    rows: Positions,
    check: NDArray[np.bool_],
    fitted: Collection[tuple[str, str]] | None,
    *,
    any_check: bool,
) -> tuple[str, ...]:
    if fitted is not None:
        keys = set(fitted)
        pairs = zip(rows.placement, rows.point, strict=True)
        return tuple(FITTED if pair in keys else CHECK for pair in pairs)
    if any_check:
        return tuple(CHECK if value else FITTED for value in check)
    return (UNKNOWN,) * len(rows)


def _members(
    used: NDArray[np.bool_], role: tuple[str, ...], inside: NDArray[np.bool_], *, with_volume: bool
) -> dict[str, NDArray[np.bool_]]:
    """Say which rows belong to which group of averages."""
    members = {"all": used}
    roles = np.array(role)
    if UNKNOWN not in role:
        members.update({name: used & (roles == name) for name in (FITTED, CHECK)})
    if with_volume:
        members.update({"inside": used & inside, "outside": used & ~inside})
    return members


def _inside(original_mm: FloatArray, volume_mm: ArrayLike | None) -> NDArray[np.bool_]:
    if volume_mm is None:
        return np.ones(len(original_mm), dtype=np.bool_)
    lower, upper = frozen_array(volume_mm, (2, 3), "volume_mm")
    # the block's own corner points must not fall out by the rounding of a bounding box
    slack = 1e-9 * (1 + np.abs(upper - lower))
    within: NDArray[np.bool_] = (
        (original_mm >= lower - slack) & (original_mm <= upper + slack)
    ).all(axis=1)
    return within
