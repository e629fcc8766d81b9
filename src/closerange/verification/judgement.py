"""Limits of an acceptance test, and how figures are judged by them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.verification.statistics import AXES, ErrorSummary, PooledStd

ACCEPT, REJECT, UNDECIDED = "accept", "reject", "undecided"

CONFIDENCE = 0.95
"""Default probability with which a decision is right at the very limit, as in ISO 14253-1."""


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
    confidence : float
        Probability with which an acceptance or a rejection is right: it sets the guard bands.
    """

    accuracy_mm: FloatArray
    repeatability_mm: FloatArray
    cycle_time_s: float
    confidence: float = CONFIDENCE

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
        confidence: float = CONFIDENCE,
    ) -> Limits:
        """Build from what is limited.

        Parameters
        ----------
        accuracy_mm, repeatability_mm : array_like, optional
            One number for all axes, or one for each of X, Y, Z.
        cycle_time_s : float, optional
            Largest cycle time.
        confidence : float, optional
            From 0.5, no guard band, to below 1.

        Returns
        -------
        Limits
            What is not given has no limit.

        Raises
        ------
        InputError
            If a limit is not positive, or the confidence is out of its range.
        """
        values: dict[str, FloatArray] = {
            "accuracy_mm": _three(accuracy_mm, "accuracy_mm"),
            "repeatability_mm": _three(repeatability_mm, "repeatability_mm"),
            "cycle_time_s": np.array(np.nan if cycle_time_s is None else cycle_time_s),
        }
        for name, value in values.items():
            if np.any(value <= 0):
                raise InputError(f"limit {name} is {value}", remedy="limits must exceed 0")
        if not 0.5 <= confidence < 1:
            raise InputError(
                f"confidence is {confidence}", remedy="give a number from 0.5 to below 1"
            )
        return cls(
            values["accuracy_mm"],
            values["repeatability_mm"],
            float(values["cycle_time_s"]),
            confidence,
        )

    @property
    def guard(self) -> float:
        """Guard band in standard uncertainties: the one-sided point of the normal distribution."""
        return NormalDist().inv_cdf(self.confidence)


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


def judge(name: str, value: float, limit: float, *, guard: float, unit: str) -> Judgement:
    """Decide on one figure with a guard band on either side of its limit.

    Parameters
    ----------
    name : str
        Of the figure.
    value, limit : float
        Figure and limit; an unknown figure (NaN) is undecided.
    guard : float
        Guard band: the limits' own `guard` times the standard uncertainty of the figure as a test
        value, which is that of the reference, or of an estimate from few readings, not of the
        instrument under test.
    unit : str
        For the report.

    Returns
    -------
    Judgement
        ISO 14253-1: accept within limit - guard, reject beyond limit + guard, otherwise undecided.
    """
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
        judge(name, float(value), float(limit), guard=limits.guard * float(uncertainty), unit=unit)
        for name, value, limit, uncertainty, unit in figures
        if not np.isnan(limit)
    )


def overall_decision(decisions: Iterable[str], *, reserved: bool = False) -> str | None:
    """Combine decisions.

    Parameters
    ----------
    decisions : iterable of str
        Of single figures.
    reserved : bool, optional
        Whether something forbids acceptance, whatever the figures.

    Returns
    -------
    str or None
        One rejection rejects, acceptance needs all and no reservation; None without any.
    """
    found = set(decisions)
    if not found:
        return None
    if REJECT in found:
        return REJECT
    return ACCEPT if found == {ACCEPT} and not reserved else UNDECIDED


def _three(value: ArrayLike | None, name: str) -> FloatArray:
    """Spread one number, or check three; None becomes NaN."""
    array = np.asarray(np.nan if value is None else value, dtype=np.float64)
    if array.shape not in ((), (3,)):
        raise InputError(
            f"limit {name} has shape {array.shape}",
            remedy="give one number, or one for each of X, Y, Z",
        )
    return np.broadcast_to(array, (3,))
