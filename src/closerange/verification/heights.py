"""Measured heights of parts whose tops are known (Tables 5.1, 5.2 and 5.4 of the thesis)."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.errors import CloseRangeWarning, DataError
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_array, frozen_ints
from closerange.position.positions import Positions
from closerange.verification.control_check import usable
from closerange.verification.known_parts import Parts
from closerange.verification.result_file import plain
from closerange.verification.standing import hollow_text

TOLERANCE_MM = 1.0
"""How far in X and Y a point may lie from the outline or the middle of a top and still be taken for
a point of it. Far above the uncertainty of any point worth using, far below the size of a part."""

OUTSIDE_SIGMA = 3.0
"""A less certain point may lie so many of its own standard deviations away."""

FEWEST = 5
"""Points on an outline below which their median says nothing of the others."""

OUTLINE, MIDDLE = "outline", "middle"

_COLUMNS = (
    "actual_mm",
    "measured_mm",
    "error_mm",
    "std_mm",
    "worst_mm",
    "predicted_std_mm",
)
_ROWS = ("placement", "part", "shape", "place", "count", *_COLUMNS, "used")


@dataclass(frozen=True, slots=True, eq=False)
class HeightCheck:
    """Heights of parts; N rows, one for each part and kind of points.

    Attributes
    ----------
    placement, part, shape : tuple of str
        As in the table of parts.
    place : tuple of str
        ``outline``: points around the top; ``middle``: one point there, as a centroid.
    count : ndarray of int, shape (N,)
        Points of each row.
    actual_mm, measured_mm, error_mm : ndarray, shape (N,)
        Known height, median of the measured ones, and measured minus actual; heights are over
        what the part stands on.
    std_mm : ndarray, shape (N,)
        Standard deviation of single points about their mean; NaN of one point.
    worst_mm : ndarray, shape (N,)
        Error of the single point that is farthest off.
    predicted_std_mm : ndarray, shape (N,)
        Standard deviation in Z that the points' covariances state, rms.
    used : ndarray of bool, shape (N,)
        Whether there were enough points for the summaries.
    tolerance_mm : float
        See `height_test`.
    bias_mm, rms_mm, max_mm : float
        Mean, rms and largest absolute error of the parts.
    points_median_mm, points_p95_mm, points_max_mm : float
        Median, 95th percentile and largest of the absolute errors of all single points.
    elsewhere : int
        Usable points that belong to no top: other edges, the ground, gross mismatches.
    flagged : int
        Points without a position, or with a flag that condemns them.
    missing : tuple of (str, str)
        (placement, part) without enough points.
    reservations : tuple of str
        What was not compared.
    """

    placement: tuple[str, ...]
    part: tuple[str, ...]
    shape: tuple[str, ...]
    place: tuple[str, ...]
    count: IntArray
    actual_mm: FloatArray
    measured_mm: FloatArray
    error_mm: FloatArray
    std_mm: FloatArray
    worst_mm: FloatArray
    predicted_std_mm: FloatArray
    used: NDArray[np.bool_]
    tolerance_mm: float
    bias_mm: float
    rms_mm: float
    max_mm: float
    points_median_mm: float
    points_p95_mm: float
    points_max_mm: float
    elsewhere: int
    flagged: int
    missing: tuple[tuple[str, str], ...] = ()
    reservations: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        rows = len(self.part)
        for name in _COLUMNS:
            object.__setattr__(self, name, frozen_array(getattr(self, name), (rows,), name))
        object.__setattr__(self, "count", frozen_ints(self.count, (rows,), "count"))
        used = np.array(self.used, dtype=np.bool_)
        used.flags.writeable = False
        object.__setattr__(self, "used", used)

    def __len__(self) -> int:
        return len(self.part)

    @property
    def hollow(self) -> str:
        """Why the figures stand on too few parts; empty where most were measured."""
        measured = {
            key
            for key, use in zip(zip(self.placement, self.part, strict=True), self.used, strict=True)
            if use
        }
        return hollow_text(len(self.missing), len(self.missing) + len(measured), "parts")

    def __str__(self) -> str:
        return (
            f"heights of {int(self.used.sum())} parts: rms error {1000 * self.rms_mm:.3g} um, "
            f"largest {1000 * self.max_mm:.3g} um"
        )

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document; null = not known."""
        document = plain(self)
        rows = {name: document.pop(name) for name in _ROWS}
        return {
            "kind": "heights",
            "error_sign": "measured minus actual",
            "rows": rows,
            **document,
        }


def height_test(
    positions: Positions, parts: Parts, *, tolerance_mm: float = TOLERANCE_MM
) -> HeightCheck:
    """Compare measured points on the tops of parts with the heights that are known.

    Parameters
    ----------
    positions : Positions
        Measured points, of edges or of centroids; their names do not matter.
    parts : Parts
        What stands where.
    tolerance_mm : float, optional
        Distance in X and Y up to which a point belongs to an outline, or to the middle of a top.
        A less certain point may be three of its standard deviations away.

    Returns
    -------
    HeightCheck
        A point counts for the top whose outline (or middle) is nearest in X and Y, if it lies
        above half the part's height: the foot of an upright side has the same X and Y.

    Raises
    ------
    DataError
        If no point is on any top.

    Warns
    -----
    CloseRangeWarning
        Of parts without enough points.
    """
    good = usable(positions)
    belongs, place = _assign(positions, parts, good, tolerance_mm)
    if not (belongs >= 0).any():
        raise DataError(
            f"none of {int(good.sum())} usable positions lies on a top of the {len(parts)} parts",
            remedy="check that the table is of this scene and in the frame of the rig",
        )
    rows = _rows(positions, parts, belongs, place)
    used = np.array([row.enough for row in rows])
    error = np.array([row.error_mm for row in rows])
    single = np.concatenate([row.errors_mm for row in rows])
    missing, reservations = _missing(parts, rows)
    for text in reservations:
        warnings.warn(text, CloseRangeWarning, stacklevel=2)
    known = error[used]
    return HeightCheck(
        placement=tuple(parts.placement[row.part] for row in rows),
        part=tuple(parts.part[row.part] for row in rows),
        shape=tuple(parts.shape[row.part] for row in rows),
        place=tuple(row.place for row in rows),
        count=np.array([len(row.errors_mm) for row in rows]),
        actual_mm=np.array([parts.height_mm[row.part] for row in rows]),
        measured_mm=np.array([parts.height_mm[row.part] + row.error_mm for row in rows]),
        error_mm=error,
        std_mm=np.array([row.std_mm for row in rows]),
        worst_mm=np.array([row.worst_mm for row in rows]),
        predicted_std_mm=np.array([row.predicted_mm for row in rows]),
        used=used,
        tolerance_mm=tolerance_mm,
        bias_mm=float(known.mean()) if known.size else np.nan,
        rms_mm=float(np.sqrt((known**2).mean())) if known.size else np.nan,
        max_mm=float(np.abs(known).max()) if known.size else np.nan,
        points_median_mm=float(np.median(np.abs(single))),
        points_p95_mm=float(np.quantile(np.abs(single), 0.95)),
        points_max_mm=float(np.abs(single).max()),
        elsewhere=int((good & (belongs < 0)).sum()),
        flagged=int((~good).sum()),
        missing=missing,
        reservations=reservations,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """Points of one top: errors of single heights, and their stated standard deviations."""

    part: int
    place: str
    errors_mm: FloatArray
    stated_mm: FloatArray

    @property
    def enough(self) -> bool:
        return self.place == MIDDLE or len(self.errors_mm) >= FEWEST

    @property
    def error_mm(self) -> float:
        return float(np.median(self.errors_mm))

    @property
    def std_mm(self) -> float:
        return float(self.errors_mm.std(ddof=1)) if len(self.errors_mm) > 1 else np.nan

    @property
    def worst_mm(self) -> float:
        return float(self.errors_mm[np.argmax(np.abs(self.errors_mm))])

    @property
    def predicted_mm(self) -> float:
        known = self.stated_mm[np.isfinite(self.stated_mm)]
        return float(np.sqrt((known**2).mean())) if known.size else np.nan


def _assign(
    positions: Positions, parts: Parts, good: BoolArray, tolerance_mm: float
) -> tuple[IntArray, BoolArray]:
    """Return each position's part, -1 for none, and whether it lies on the outline of its top."""
    xyz = positions.xyz_mm
    spread = np.nan_to_num(np.trace(positions.cov_mm2[:, :2, :2], axis1=1, axis2=2))
    reach = np.maximum(tolerance_mm, OUTSIDE_SIGMA * np.sqrt(np.maximum(spread, 0.0)))
    nearest = np.full(len(positions), np.inf)
    belongs = np.full(len(positions), -1, dtype=np.int64)
    outline = np.zeros(len(positions), dtype=np.bool_)
    placement = np.array(positions.placement, dtype=np.object_)
    for row in range(len(parts)):
        high = (xyz[:, 2] - parts.base_mm[row]) / parts.height_mm[row] > 0.5
        here = good & high & ((placement == parts.placement[row]) | (parts.placement[row] == ""))
        edge = np.abs(parts.outside_mm(row, xyz[:, :2]))
        middle = np.hypot(*(xyz[:, :2] - parts.top_mm[row, :2]).T)
        distance = np.minimum(edge, middle)
        take = here & (distance <= reach) & (distance < nearest)
        nearest[take], belongs[take], outline[take] = distance[take], row, (edge <= middle)[take]
    return belongs, outline


def _rows(positions: Positions, parts: Parts, belongs: IntArray, outline: BoolArray) -> list[_Row]:
    """Gather the points of each top."""
    stated = np.sqrt(positions.cov_mm2[:, 2, 2])
    found = []
    for part in range(len(parts)):
        for place, mask in ((OUTLINE, outline), (MIDDLE, ~outline)):
            rows = np.flatnonzero((belongs == part) & mask)
            if rows.size:
                # a height over ground is negative where Z points down: so is its error then
                error = positions.xyz_mm[rows, 2] - parts.top_mm[part, 2]
                found.append(_Row(part, place, error, stated[rows]))
    return found


def _missing(parts: Parts, rows: list[_Row]) -> tuple[tuple[tuple[str, str], ...], tuple[str, ...]]:
    """Name the parts without enough points, and say so."""
    measured = {row.part for row in rows if row.enough}
    missing = tuple(
        (parts.placement[part], parts.part[part])
        for part in range(len(parts))
        if part not in measured
    )
    if not missing:
        return (), ()
    names = ", ".join(part for _, part in missing[:5]) + ", ..." * (len(missing) > 5)
    text = (
        f"{len(missing)} of {len(parts)} parts ({names}) have fewer than {FEWEST} usable points on "
        "the outline of their top"
    )
    return missing, (text,)
