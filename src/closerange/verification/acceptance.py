"""The acceptance report: figures of merit, limits and the decision."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.flags import format_flags
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.verification.result_file import plain
from closerange.verification.statistics import (
    AXES,
    AxisSlopes,
    Coverage,
    ErrorSummary,
    LuckOfTest,
    PooledStd,
)

_ROWS = (
    "placement",
    "point",
    "count",
    "truth_mm",
    "mean_mm",
    "std_mm",
    "range_mm",
    "predicted_cov_mm2",
    "flags",
)
ACCEPT, REJECT, UNDECIDED = "accept", "reject", "undecided"

GUARD = 1.65
"""One-sided 95 % point of the normal distribution: guard band in standard uncertainties."""


@dataclass(frozen=True, slots=True, eq=False)
class Limits:
    """Largest figures that the buyer accepts.

    Attributes
    ----------
    accuracy_mm : ndarray, shape (3,)
        Of abs(error) of any position's mean, along X, Y, Z; NaN = no limit.
    repeatability_mm : ndarray, shape (3,)
        Of the pooled standard deviation; NaN = no limit.
    cycle_time_s : float
        NaN = no limit.
    """

    accuracy_mm: FloatArray
    repeatability_mm: FloatArray
    cycle_time_s: float

    def __post_init__(self) -> None:
        for name in ("accuracy_mm", "repeatability_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (3,), name))

    @classmethod
    def of(
        cls,
        *,
        accuracy_mm: ArrayLike | None = None,
        repeatability_mm: ArrayLike | None = None,
        cycle_time_s: float | None = None,
    ) -> Limits:
        """Build from what is limited.

        Parameters
        ----------
        accuracy_mm, repeatability_mm : array_like, optional
            One number for all axes, or one for each of X, Y, Z.
        cycle_time_s : float, optional
            Largest cycle time.

        Returns
        -------
        Limits
            What is not given has no limit.

        Raises
        ------
        InputError
            If a limit is not positive.
        """
        values: dict[str, FloatArray] = {
            "accuracy_mm": _three(accuracy_mm, "accuracy_mm"),
            "repeatability_mm": _three(repeatability_mm, "repeatability_mm"),
            "cycle_time_s": np.array(np.nan if cycle_time_s is None else cycle_time_s),
        }
        for name, value in values.items():
            if np.any(value <= 0):
                raise InputError(f"limit {name} is {value}", remedy="limits must exceed 0")
        return cls(values["accuracy_mm"], values["repeatability_mm"], float(values["cycle_time_s"]))


@dataclass(frozen=True, slots=True)
class Judgement:
    """One figure against its limit.

    Attributes
    ----------
    name : str
        Such as ``accuracy X``.
    value, limit : float
        Figure and limit, in `unit`.
    guard : float
        Guard band, in `unit`.
    unit : str
        ``mm`` or ``s``.
    decision : str
        ``accept``, ``reject`` or ``undecided``.
    """

    name: str
    value: float
    limit: float
    guard: float
    unit: str
    decision: str


@dataclass(frozen=True, slots=True, eq=False)
class Repeatability:
    """How far readings of one position scatter.

    Attributes
    ----------
    pooled : PooledStd
        Over all positions with two or more readings, frozen ones left out.
    worst_std_mm, largest_range_mm : ndarray, shape (3,)
        Largest standard deviation and largest max - min of any position.
    """

    pooled: PooledStd
    worst_std_mm: FloatArray
    largest_range_mm: FloatArray

    def __post_init__(self) -> None:
        for name in ("worst_std_mm", "largest_range_mm"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (3,), name))


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Observed figures against those that the covariances predict.

    Attributes
    ----------
    noise_share : float
        Share of the predicted variance of one reading that differs between readings; the rest
        is common to all of them: the calibration, the roughness of the target. NaN if unknown.
    accuracy_ratio : ndarray, shape (4,)
        rms error of the means / predicted (common part + noise / M + reference); X, Y, Z, 3-D.
    repeatability_ratio : ndarray, shape (4,)
        Pooled standard deviation / that predicted from image noise. Without stated noise the
        prediction is that of a whole reading: an upper limit, which the ratio should stay below.
    noise_stated : bool
        Whether the covariance of the noise alone was given.
    """

    noise_share: float
    accuracy_ratio: FloatArray
    repeatability_ratio: FloatArray
    noise_stated: bool

    def __post_init__(self) -> None:
        for name in ("accuracy_ratio", "repeatability_ratio"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (4,), name))


@dataclass(frozen=True, slots=True, eq=False)
class AcceptanceReport:
    """Result of a single-point test; P positions.

    Attributes
    ----------
    placement, point : tuple of str
        Names of the positions.
    count : ndarray of int, shape (P,)
        Readings used.
    truth_mm, mean_mm : ndarray, shape (P, 3)
        Actual position and mean of the readings.
    std_mm, range_mm : ndarray, shape (P, 3)
        Standard deviation about the mean and max - min; NaN for a single reading.
    predicted_cov_mm2 : ndarray, shape (P, 3, 3)
        Predicted covariance of the error, the reference's included; NaN if unknown.
    flags : ndarray of int, shape (P,)
        `frozen`, and what is said of readings that were used all the same.
    accuracy : ErrorSummary
        Of actual minus mean, the sign of the thesis.
    repeatability : Repeatability
        Of readings about their mean.
    luck : LuckOfTest
        Chance alone.
    slopes : AxisSlopes
        Dependence of the error on the position.
    coverage : Coverage
        95 % regions of the means.
    prediction : Prediction
        Observed / predicted.
    reference_std_mm : float
        Standard deviation of the actual positions (largest); 0 = taken as exact.
    cycle_time_s : float
        NaN if not stated.
    limits : Limits or None
        As agreed.
    judgements : tuple of Judgement
        Each limited figure.
    decision : str or None
        ``accept`` if all are, ``reject`` if one is, else ``undecided``; None without limits.
    missing : tuple of (str, str, str)
        (placement, reading, point) without a truth.
    left_out : tuple of (str, str, str, str)
        (placement, reading, point, flags) not used because flagged or not measured.
    deviations : tuple of str
        From the procedure of A15.05.
    warnings : tuple of str
        What the reader must know.
    """

    placement: tuple[str, ...]
    point: tuple[str, ...]
    count: IntArray
    truth_mm: FloatArray
    mean_mm: FloatArray
    std_mm: FloatArray
    range_mm: FloatArray
    predicted_cov_mm2: FloatArray
    flags: IntArray
    accuracy: ErrorSummary
    repeatability: Repeatability
    luck: LuckOfTest
    slopes: AxisSlopes
    coverage: Coverage
    prediction: Prediction
    reference_std_mm: float
    cycle_time_s: float
    limits: Limits | None
    judgements: tuple[Judgement, ...]
    decision: str | None
    missing: tuple[tuple[str, str, str], ...] = ()
    left_out: tuple[tuple[str, str, str, str], ...] = ()
    deviations: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        positions = len(self.point)
        object.__setattr__(self, "count", frozen_ints(self.count, (positions,), "count"))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (positions,), "flags"))
        for name in ("truth_mm", "mean_mm", "std_mm", "range_mm"):
            value = frozen_array(getattr(self, name), (positions, 3), name)
            object.__setattr__(self, name, value)
        cov = frozen_array(self.predicted_cov_mm2, (positions, 3, 3), "predicted_cov_mm2")
        object.__setattr__(self, "predicted_cov_mm2", cov)

    def __len__(self) -> int:
        return len(self.point)

    @property
    def error_mm(self) -> FloatArray:
        """Actual minus mean, shape (P, 3)."""
        return self.truth_mm - self.mean_mm

    def __str__(self) -> str:
        accuracy, repeatability = self.accuracy.max_mm, self.repeatability.pooled.std_mm
        text = (
            f"{len(self)} positions: accuracy {_axes(accuracy)}, repeatability "
            f"{_axes(repeatability)} (95 % region holds {100 * self.coverage.share:.1f} %)"
        )
        return f"{text}: {self.decision}" if self.decision else text

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document; null = not known."""
        document = plain(self)
        rows = {name: document.pop(name) for name in _ROWS}
        rows["error_mm"] = plain(self.error_mm)
        rows["flags"] = [format_flags(int(flag)) for flag in self.flags]
        signs = {"axes": list(AXES), "error_sign": "actual minus mean"}
        return {"kind": "single-point", **signs, "rows": rows, **document}


def judge(name: str, value: float, limit: float, *, uncertainty: float, unit: str) -> Judgement:
    """Decide on one figure with a guard band on either side of its limit.

    Parameters
    ----------
    name : str
        Of the figure.
    value, limit : float
        Figure and limit; an unknown figure (NaN) is undecided.
    uncertainty : float
        Standard uncertainty of the figure as a test value: of the reference, or of an estimate
        from few readings, not of the instrument under test.
    unit : str
        For the report.

    Returns
    -------
    Judgement
        ISO 14253-1: accept within limit - g, reject beyond limit + g, g = 1.65 uncertainties
        (95 %, one-sided), otherwise undecided.
    """
    guard = GUARD * uncertainty
    decision = UNDECIDED
    if value + guard <= limit:
        decision = ACCEPT
    elif value - guard > limit:
        decision = REJECT
    return Judgement(name, float(value), float(limit), float(guard), unit, decision)


def judge_all(
    accuracy: ErrorSummary,
    pooled: PooledStd,
    limits: Limits | None,
    *,
    reference_mm: float,
    cycle_time_s: float,
) -> tuple[Judgement, ...]:
    """Judge every figure that has a limit.

    Parameters
    ----------
    accuracy : ErrorSummary
        Its largest absolute errors are judged, with the uncertainty of the reference.
    pooled : PooledStd
        Judged with its own uncertainty.
    limits : Limits or None
        None judges nothing.
    reference_mm : float
        Standard deviation of the actual positions.
    cycle_time_s : float
        NaN if unknown.

    Returns
    -------
    tuple of Judgement
        In the order accuracy, repeatability, cycle time.
    """
    if limits is None:
        return ()
    spread = pooled.std_mm * pooled.relative_uncertainty
    figures = [
        (f"accuracy {axis}", accuracy.max_mm[i], limits.accuracy_mm[i], reference_mm, "mm")
        for i, axis in enumerate(AXES[:3])
    ]
    figures += [
        (f"repeatability {axis}", pooled.std_mm[i], limits.repeatability_mm[i], spread[i], "mm")
        for i, axis in enumerate(AXES[:3])
    ]
    figures.append(("cycle time", cycle_time_s, limits.cycle_time_s, 0.0, "s"))
    return tuple(
        judge(name, float(value), float(limit), uncertainty=float(uncertainty), unit=unit)
        for name, value, limit, uncertainty, unit in figures
        if not np.isnan(limit)
    )


def overall_decision(decisions: Iterable[str]) -> str | None:
    """Combine decisions: one rejection rejects, acceptance needs all, none gives None."""
    found = set(decisions)
    if not found:
        return None
    if REJECT in found:
        return REJECT
    return ACCEPT if found == {ACCEPT} else UNDECIDED


def _three(value: ArrayLike | None, name: str) -> FloatArray:
    """Spread one number, or check three; None becomes NaN."""
    array = np.asarray(np.nan if value is None else value, dtype=np.float64)
    if array.shape not in ((), (3,)):
        raise InputError(
            f"limit {name} has shape {array.shape}",
            remedy="give one number, or one for each of X, Y, Z",
        )
    return np.broadcast_to(array, (3,))


def _axes(value_mm: FloatArray) -> str:
    texts = (
        f"{1000 * value:.3g} um ({axis})" for value, axis in zip(value_mm[:3], AXES, strict=False)
    )
    return " ".join(texts)
