"""Measured distances between points against calibrated lengths."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import CloseRangeWarning, DataError, TableError
from closerange.files import CsvTable, read_csv, text_cell
from closerange.flags import format_flags
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.position.positions import Positions
from closerange.verification.control_check import usable
from closerange.verification.result_file import plain
from closerange.verification.standing import hollow_text

REQUIRED = ("point_a", "point_b", "length_mm")
OPTIONAL = ("placement", "std_mm")
_ROWS = (
    "placement",
    "reading",
    "point_a",
    "point_b",
    "true_mm",
    "measured_mm",
    "error_mm",
    "predicted_std_mm",
    "used",
    "flags",
)


@dataclass(frozen=True, slots=True, eq=False)
class Lengths:
    """Known distances between points; N rows.

    Attributes
    ----------
    placement : tuple of str
        Blank = holds in every placement in which both points are measured.
    point_a, point_b : tuple of str
        The two ends.
    length_mm : ndarray, shape (N,)
        True distance.
    std_mm : ndarray, shape (N,)
        Its standard deviation; 0 = exact.
    """

    placement: tuple[str, ...]
    point_a: tuple[str, ...]
    point_b: tuple[str, ...]
    length_mm: FloatArray
    std_mm: FloatArray

    def __post_init__(self) -> None:
        count = len(self.point_a)
        if len(self.point_b) != count or len(self.placement) != count:
            raise ValueError("placement, point_a and point_b differ in length")
        for name in ("placement", "point_a", "point_b"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("length_mm", "std_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count,), name))

    @classmethod
    def of(
        cls,
        point_a: Sequence[str],
        point_b: Sequence[str],
        length_mm: ArrayLike,
        *,
        placement: str | Sequence[str] = "",
        std_mm: ArrayLike = 0.0,
    ) -> Lengths:
        """Build from pairs of points; `placement` and `std_mm` may be one value for all rows."""
        count = len(point_a)
        placements = (placement,) * count if isinstance(placement, str) else tuple(placement)
        return cls(
            placements,
            tuple(point_a),
            tuple(point_b),
            np.asarray(length_mm, np.float64),
            np.broadcast_to(np.asarray(std_mm, np.float64), (count,)),
        )

    def __len__(self) -> int:
        return len(self.point_a)


@dataclass(frozen=True, slots=True, eq=False)
class LengthCheck:
    """Comparison of distances; N measured lengths.

    Attributes
    ----------
    placement, reading, point_a, point_b : tuple of str
        Names.
    true_mm, measured_mm, error_mm : ndarray, shape (N,)
        Known, measured, and measured minus known.
    predicted_std_mm : ndarray, shape (N,)
        From the covariances of both ends and the reference. The ends' correlation through the
        common calibration is ignored: for a short length this overstates. NaN if unknown.
    flags : ndarray of int, shape (N,)
        Flags of either end; a length with a flag that condemns an end is listed, not averaged.
    used : ndarray of bool, shape (N,)
        Took part in the summaries.
    bias_mm, rms_mm, max_mm : float
        Mean, RMS and largest absolute error.
    ratio : float
        RMS of error / predicted; 1 if the prediction holds. NaN if unknown.
    missing : tuple of (str, str, str)
        (placement, point_a, point_b) of lengths that were not measured: in no placement, or not
        in one whose table lists both ends.
    reservations : tuple of str
        What was not compared: nothing is known of it, however good the rest.
    """

    placement: tuple[str, ...]
    reading: tuple[str, ...]
    point_a: tuple[str, ...]
    point_b: tuple[str, ...]
    true_mm: FloatArray
    measured_mm: FloatArray
    error_mm: FloatArray
    predicted_std_mm: FloatArray
    flags: IntArray
    used: NDArray[np.bool_]
    bias_mm: float
    rms_mm: float
    max_mm: float
    ratio: float
    missing: tuple[tuple[str, str, str], ...] = ()
    reservations: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.point_a)
        for name in ("true_mm", "measured_mm", "error_mm", "predicted_std_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count,), name))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (count,), "flags"))
        used = np.array(self.used, dtype=np.bool_)
        used.flags.writeable = False
        object.__setattr__(self, "used", used)

    def __len__(self) -> int:
        return len(self.point_a)

    @property
    def hollow(self) -> str:
        """Why the figures stand on too few lengths; empty where most were used."""
        lost = int((~self.used).sum()) + len(self.missing)
        return hollow_text(lost, len(self) + len(self.missing), "lengths")

    def __str__(self) -> str:
        return (
            f"{int(self.used.sum())} lengths: rms error {1000 * self.rms_mm:.3g} um, "
            f"largest {1000 * self.max_mm:.3g} um"
        )

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document; null = not known."""
        document = plain(self)
        rows = {name: document.pop(name) for name in _ROWS}
        rows["flags"] = [format_flags(int(flag)) for flag in self.flags]
        signs = {"error_sign": "measured minus true", "correlation": "ignored between the ends"}
        return {"kind": "lengths", **signs, "rows": rows, **document}


def read_lengths(path: Path | str) -> Lengths:
    """Read a table of known lengths.

    Parameters
    ----------
    path : Path or str
        CSV file with ``point_a, point_b, length_mm`` and optionally ``placement, std_mm``.

    Returns
    -------
    Lengths
        Its rows.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract: it names file, row, column and remedy.
    """
    table = read_csv(path, required=REQUIRED, optional=OPTIONAL)
    ends = {
        name: [text_cell(t, table.where(i, name)) for i, t in enumerate(table.texts(name))]
        for name in REQUIRED[:2]
    }
    length, std = table.floats("length_mm"), table.floats("std_mm", blank=0.0)
    _check_rows(table, length, std)
    return Lengths.of(
        ends["point_a"], ends["point_b"], length, placement=table.texts("placement"), std_mm=std
    )


def length_test(positions: Positions, truth: Lengths) -> LengthCheck:
    """Compare distances between measured points with known lengths.

    Parameters
    ----------
    positions : Positions
        Measured; both ends of a length are taken from one placement and one reading.
    truth : Lengths
        Known distances.

    Returns
    -------
    LengthCheck
        Errors are measured minus true.

    Raises
    ------
    DataError
        If no length has both of its ends measured.
    """
    row_a, row_b, row_truth, missing = _pair_rows(positions, truth)
    if not len(row_truth):
        raise DataError(
            f"none of {len(truth)} lengths has both ends among the {len(positions)} positions",
            remedy="use the same names of placements and points in both tables",
        )
    difference = positions.xyz_mm[row_b] - positions.xyz_mm[row_a]
    measured = np.linalg.norm(difference, axis=1)
    error = measured - truth.length_mm[row_truth]
    predicted = _predicted_std(positions, row_a, row_b, truth.std_mm[row_truth])
    good = usable(positions)
    used = good[row_a] & good[row_b]
    reservations = _reservations(used, len(missing))
    for text in reservations:
        warnings.warn(text, CloseRangeWarning, stacklevel=2)
    known = used & (predicted > 0)
    return LengthCheck(
        placement=tuple(positions.placement[i] for i in row_a),
        reading=tuple(positions.reading[i] for i in row_a),
        point_a=tuple(truth.point_a[i] for i in row_truth),
        point_b=tuple(truth.point_b[i] for i in row_truth),
        true_mm=truth.length_mm[row_truth],
        measured_mm=measured,
        error_mm=error,
        predicted_std_mm=predicted,
        flags=positions.flags[row_a] | positions.flags[row_b],
        used=used,
        bias_mm=float(error[used].mean()) if used.any() else np.nan,
        rms_mm=_rms(error[used]),
        max_mm=float(np.abs(error[used]).max()) if used.any() else np.nan,
        ratio=_rms(error[known] / predicted[known]),
        missing=missing,
        reservations=reservations,
    )


def _reservations(used: NDArray[np.bool_], missing: int) -> tuple[str, ...]:
    """Say what was not compared."""
    left_out, total = int((~used).sum()), len(used) + missing
    found = [
        (missing, f"{missing} of {total} lengths were not measured"),
        (left_out, f"{left_out} of {total} lengths have a flagged end and were left out"),
    ]
    return tuple(text for applies, text in found if applies)


def _pair_rows(
    positions: Positions, truth: Lengths
) -> tuple[IntArray, IntArray, IntArray, tuple[tuple[str, str, str], ...]]:
    """Find the rows of both ends of each length, in every placement and reading that lists them."""
    index: dict[tuple[str, str], dict[str, int]] = {}
    for row, (placement, reading, point) in enumerate(positions.keys()):
        index.setdefault((placement, reading), {})[point] = row
    measured = positions.measured
    found: list[tuple[int, int, int]] = []
    missing = []
    for i, (where, a, b) in enumerate(
        zip(truth.placement, truth.point_a, truth.point_b, strict=True)
    ):
        listed = [
            (placement, rows[a], rows[b])
            for (placement, _), rows in index.items()
            if where in ("", placement) and a in rows and b in rows
        ]
        found += [(x, y, i) for _, x, y in listed if measured[x] and measured[y]]
        missing += [(name, a, b) for name, x, y in listed if not (measured[x] and measured[y])]
        if not listed:
            missing.append((where, a, b))
    row_a, row_b, row_truth = np.array(found, dtype=np.int64).reshape(-1, 3).T
    return row_a, row_b, row_truth, tuple(missing)


def _predicted_std(
    positions: Positions, row_a: IntArray, row_b: IntArray, reference_mm: FloatArray
) -> FloatArray:
    """Propagate the ends' covariances along the line between them."""
    difference = positions.xyz_mm[row_b] - positions.xyz_mm[row_a]
    length = np.linalg.norm(difference, axis=1, keepdims=True)
    unit = np.divide(difference, length, out=np.zeros_like(difference), where=length > 0)
    cov = positions.cov_mm2[row_a] + positions.cov_mm2[row_b]
    variance = np.einsum("ni,nij,nj->n", unit, cov, unit)
    predicted: FloatArray = np.sqrt(np.maximum(variance, 0.0) + reference_mm**2)
    return predicted


def _rms(values: FloatArray) -> float:
    return float(np.sqrt((values**2).mean())) if values.size else float("nan")


def _check_rows(table: CsvTable, length: list[float], std: list[float]) -> None:
    names = ("point_a", "point_b")
    for row, (a, b) in enumerate(zip(*(table.texts(name) for name in names), strict=True)):
        if a == b:
            raise TableError(
                f"{table.where(row, 'point_b')}: both ends are point {a!r}",
                remedy="name two different points",
            )
        if length[row] <= 0:
            raise TableError(
                f"{table.where(row, 'length_mm')}: {length[row]} mm; a length exceeds 0",
                remedy="write the calibrated length in mm",
            )
        if std[row] < 0:
            raise TableError(
                f"{table.where(row, 'std_mm')}: {std[row]} mm; a standard deviation is not "
                "negative",
                remedy="write its magnitude, or leave the cell blank for an exact length",
            )
