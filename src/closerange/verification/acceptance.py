"""The acceptance report: figures of merit, limits and the decision."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from closerange.flags import format_flags
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.verification.judgement import Judgement, Limits
from closerange.verification.result_file import plain
from closerange.verification.standing import hollow_text
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
        ``accept`` if all are and there are no reservations, ``reject`` if one is, else
        ``undecided``; None without limits, unless most readings were left out.
    missing : tuple of (str, str, str)
        (placement, reading, point) without a truth.
    left_out : tuple of (str, str, str, str)
        (placement, reading, point, flags) not used because flagged or not measured.
    deviations : tuple of str
        From the procedure of A15.05.
    warnings : tuple of str
        What the reader must know.
    reservations : tuple of str
        Why nothing is accepted, whatever the figures: readings that were left out, actual
        positions without a usable reading, frozen images, an untrustworthy rig.
    not_measured : tuple of (str, str)
        (placement, point) of actual positions without a usable reading.
    cycle_time_includes : str
        What was timed; empty if it was not said.
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
    reservations: tuple[str, ...] = ()
    not_measured: tuple[tuple[str, str], ...] = ()
    cycle_time_includes: str = ""

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

    @property
    def hollow(self) -> str:
        """Why the figures stand on too few readings; empty where most were used."""
        used, left_out = int(self.count.sum()), len(self.left_out)
        return hollow_text(left_out, used + left_out, "readings")

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


def _axes(value_mm: FloatArray) -> str:
    texts = (
        f"{1000 * value:.3g} um ({axis})" for value, axis in zip(value_mm[:3], AXES, strict=False)
    )
    return " ".join(texts)
