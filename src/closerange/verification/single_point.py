"""The single-point test of chapter 3: accuracy, repeatability and what they are worth."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import CloseRangeWarning, DataError, InputError
from closerange.features.control import ControlPoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.geometry.covariance import (
    limited_part,
    mahalanobis_squared,
    positive_definite,
)
from closerange.position.positions import Positions
from closerange.verification.acceptance import AcceptanceReport, Prediction, Repeatability
from closerange.verification.control_check import left_out_rows, usable
from closerange.verification.judgement import UNDECIDED, Limits, judge_all, overall_decision
from closerange.verification.reading_groups import Groups, group_readings
from closerange.verification.standing import hollow_text, without_reading
from closerange.verification.statistics import (
    ErrorSummary,
    LuckOfTest,
    PooledStd,
    axis_slopes,
    half_range_by_luck,
    pooled_std,
    region_coverage,
    summarise_errors,
    worst_error_by_luck,
    worst_std_by_luck,
)

POSITIONS, READINGS = 90, 10
"""Size of the test in A15.05, as chapter 3 reports it."""

REFERENCE_RATIO = 4.0
"""How many times better than the limit a reference must be to prove anything about it."""


def single_point_test(
    positions: Positions,
    truth: ControlPoints,
    *,
    cycle_time_s: float | None = None,
    cycle_time_includes: str = "",
    limits: Limits | None = None,
    gauge_std_mm: float | None = None,
    noise_cov_mm2: ArrayLike | None = None,
) -> AcceptanceReport:
    """Evaluate repeated readings of a target at known positions (chapter 3, after A15.05).

    Parameters
    ----------
    positions : Positions
        Readings; those of one (placement, point) belong to one position. Flagged rows are left
        out and listed.
    truth : ControlPoints
        Actual positions.
    cycle_time_s : float, optional
        Time from the command to the result.
    cycle_time_includes : str, optional
        What was timed, if it is less than that.
    limits : Limits, optional
        Gives a decision. Nothing is accepted while a reading is left out or has no actual
        position, or an actual position has no usable reading.
    gauge_std_mm : float, optional
        Standard deviation of the actual positions; replaces the `std_mm` of `truth`.
    noise_cov_mm2 : array_like, shape (M, 3, 3), optional
        Part of `positions.cov_mm2` that differs between readings; replaces
        `positions.noise_cov_mm2`. Where neither is known for all readings used, that part is
        estimated from their scatter, as one share of the whole covariance for all positions.

    Returns
    -------
    AcceptanceReport
        Errors are actual minus mean, as in the thesis (the opposite of `compare_with_control`).

    Raises
    ------
    DataError
        If no usable reading has a truth.
    InputError
        If `gauge_std_mm` or `cycle_time_s` is negative.
    """
    for name, value in (("gauge_std_mm", gauge_std_mm), ("cycle_time_s", cycle_time_s)):
        if value is not None and not value >= 0:
            raise InputError(f"{name} is {value}", remedy="give a number of at least 0")
    truth_row = truth.rows_for(positions.placement, positions.point)
    known, good = truth_row >= 0, usable(positions)
    if not (known & good).any():
        raise DataError(
            f"none of {len(positions)} readings is usable and has one of {len(truth)} truths",
            remedy="the flags say why readings cannot be used: measure again"
            if known.any()
            else "use the same names of placements and points in both tables",
        )
    stated = positions.noise_cov_mm2 if noise_cov_mm2 is None else noise_cov_mm2
    groups = group_readings(positions, known & good, stated)
    row = truth.rows_for(*zip(*groups.key, strict=True))
    reference = np.full(len(row), gauge_std_mm) if gauge_std_mm is not None else truth.std_mm[row]
    notes = _Notes(
        missing=tuple(key for key, has in zip(positions.keys(), known, strict=True) if not has),
        left_out=left_out_rows(positions.select(known), good[known]),
        not_measured=without_reading(positions, good, truth),
        truths=len(truth),
        cycle_time_s=np.nan if cycle_time_s is None else float(cycle_time_s),
        cycle_time_includes=cycle_time_includes,
        dof=positions.dof,
    )
    report = _evaluate(groups, truth.xyz_mm[row], reference, limits, notes)
    for text in report.warnings:
        warnings.warn(text, CloseRangeWarning, stacklevel=2)
    return report


@dataclass(frozen=True, slots=True)
class _Notes:
    """What the report says besides the figures."""

    missing: tuple[tuple[str, str, str], ...]
    left_out: tuple[tuple[str, str, str, str], ...]
    not_measured: tuple[tuple[str, str], ...]
    truths: int
    cycle_time_s: float
    cycle_time_includes: str
    dof: int | None


def _evaluate(
    groups: Groups,
    truth: FloatArray,
    reference: FloatArray,
    limits: Limits | None,
    notes: _Notes,
) -> AcceptanceReport:
    error = truth - groups.mean
    accuracy = summarise_errors(error)
    pooled = pooled_std(groups.std, groups.scatter_count)
    share = _noise_share(groups)
    predicted = _predicted_of_mean(groups, share) + reference[:, None, None] ** 2 * np.eye(3)
    judgements = judge_all(
        accuracy,
        pooled,
        limits,
        reference_mm=float(reference.max()),
        cycle_time_s=notes.cycle_time_s,
    )
    reservations = _reservations(groups, notes)
    decision = overall_decision((item.decision for item in judgements), reserved=bool(reservations))
    used, left_out = int(groups.count.sum()), len(notes.left_out)
    if decision is None and hollow_text(left_out, used + left_out, "readings"):
        decision = UNDECIDED
    return AcceptanceReport(
        placement=tuple(placement for placement, _ in groups.key),
        point=tuple(point for _, point in groups.key),
        count=groups.count,
        truth_mm=truth,
        mean_mm=groups.mean,
        std_mm=groups.std,
        range_mm=groups.range,
        predicted_cov_mm2=predicted,
        flags=groups.flags,
        accuracy=accuracy,
        repeatability=Repeatability(pooled, _worst(groups.std), _worst(groups.range)),
        luck=_luck(groups),
        slopes=axis_slopes(error, truth),
        coverage=region_coverage(error, predicted, dof=notes.dof),
        prediction=_prediction(groups, share, error, predicted, pooled),
        reference_std_mm=float(reference.max()),
        cycle_time_s=notes.cycle_time_s,
        limits=limits,
        judgements=judgements,
        decision=decision,
        missing=notes.missing,
        left_out=notes.left_out,
        deviations=_deviations(groups, truth, reference, notes),
        warnings=(*_warnings(groups, accuracy, float(reference.max()), limits), *reservations),
        reservations=reservations,
        not_measured=notes.not_measured,
        cycle_time_includes=notes.cycle_time_includes,
    )


def _noise_share(groups: Groups) -> float:
    """Return which share of a reading's predicted variance differs between readings."""
    if groups.noise is not None:
        variances = [np.trace(cov, axis1=1, axis2=2).sum() for cov in (groups.noise, groups.total)]
        return float(variances[0] / variances[1])
    return float(np.clip(_scatter_ratio(groups), 0.0, 1.0))


def _scatter_ratio(groups: Groups) -> float:
    """Return the pooled observed variance relative to the whole predicted one; NaN if unknown."""
    kept = positive_definite(groups.total) & (groups.scatter_count > 1)
    if not kept.any():
        return float("nan")
    square = mahalanobis_squared(groups.deviation, groups.total[groups.group])
    return float(square[kept[groups.group]].sum() / (3 * (groups.count[kept] - 1).sum()))


def _predicted_of_mean(groups: Groups, share: float) -> FloatArray:
    """Predict the covariance of the mean of M readings: only the noise is averaged."""
    averaged = (1 - 1 / groups.count)[:, None, None]
    if groups.noise is not None:
        return groups.total - averaged * limited_part(groups.noise, groups.total)
    # scatter of one shape with the whole covariance keeps the difference positive definite
    return groups.total * (1 - averaged * (0.0 if np.isnan(share) else share))


def _prediction(
    groups: Groups,
    share: float,
    error: FloatArray,
    predicted: FloatArray,
    pooled: PooledStd,
) -> Prediction:
    scatter = groups.total if groups.noise is None else groups.noise
    weight = np.maximum(groups.scatter_count - 1, 0)
    by_reading = np.full((3, 3), np.nan)
    if weight.any():
        by_reading = np.average(scatter[weight > 0], axis=0, weights=weight[weight > 0])
    return Prediction(
        noise_share=share,
        accuracy_ratio=_ratio((error**2).mean(axis=0), predicted.mean(axis=0)),
        repeatability_ratio=_ratio(pooled.std_mm**2, by_reading),
        noise_stated=groups.noise is not None,
    )


def _ratio(observed_variance: FloatArray, predicted: FloatArray) -> FloatArray:
    """Return observed / predicted standard deviations of X, Y, Z and in space."""
    expected = np.diag(predicted)
    expected = np.append(expected, expected.sum())
    observed = np.append(observed_variance, observed_variance.sum())
    ratio = np.full(4, np.nan)
    known = expected > 0
    ratio[known] = np.sqrt(observed[known] / expected[known])
    return ratio


def _worst(values: FloatArray) -> FloatArray:
    """Return the largest of each axis, NaN if there is none."""
    known = values[np.isfinite(values).all(axis=1)]
    return known.max(axis=0) if len(known) else np.full(3, np.nan)


def _luck(groups: Groups) -> LuckOfTest:
    """Chance alone, for the commonest number of readings."""
    several = groups.scatter_count[groups.scatter_count > 1]
    readings = int(np.bincount(several).argmax()) if several.size else 0
    return LuckOfTest(
        worst_std_by_luck(len(several), readings),
        worst_error_by_luck(len(groups.key)),
        half_range_by_luck(len(groups.key)),
    )


def _deviations(
    groups: Groups, truth: FloatArray, reference: FloatArray, notes: _Notes
) -> tuple[str, ...]:
    """List what differs from A15.05 as section 3.2 of the thesis describes it."""
    fewest = int(groups.count.min())
    found = [
        (len(groups.key) < POSITIONS, f"{len(groups.key)} positions instead of {POSITIONS}"),
        (
            fewest < READINGS,
            f"as few as {fewest} readings of a position instead of {READINGS}",
        ),
        (_in_steps(truth), "the positions lie in regular steps instead of at random"),
        (np.isnan(notes.cycle_time_s), "the cycle time is unknown"),
        (
            bool(notes.cycle_time_includes),
            "the cycle time is not that from the command to the result: "
            + notes.cycle_time_includes,
        ),
        (
            not reference.any(),
            "the uncertainty of the actual positions is not stated; they are taken as exact",
        ),
        *((True, text) for text in _omissions(groups, notes)),
        (True, "target plate and test controller are not known to the program"),
        (True, "the procedure is that of the thesis, section 3.2; the standard was not at hand"),
    ]
    return tuple(text for applies, text in found if applies)


def _in_steps(truth: FloatArray) -> bool:
    """Tell whether an axis takes few values: 90 random draws from 100 marks take 60."""
    distinct = [len(np.unique(axis.round(6))) for axis in truth.T]
    return len(truth) > 1 and min(distinct) <= len(truth) / 2


def _warnings(
    groups: Groups,
    accuracy: ErrorSummary,
    reference_mm: float,
    limits: Limits | None,
) -> tuple[str, ...]:
    single, total = int((groups.count == 1).sum()), len(groups.key)
    strictest = np.nan if limits is None else np.fmin.reduce(limits.accuracy_mm)
    proved = float(accuracy.max_mm[:3].min() if np.isnan(strictest) else strictest)
    what = "accuracy found" if np.isnan(strictest) else "accuracy limit"
    found = [
        (
            single,
            (
                f"{single} of {total} positions have one reading: one reading has no standard "
                "deviation; take at least two"
            ),
        ),
        (
            reference_mm * REFERENCE_RATIO > proved,
            (
                f"the reference ({reference_mm:.4g} mm) is not {REFERENCE_RATIO:.0f} times better "
                f"than the {what} ({proved:.4g} mm): it proves nothing below "
                f"{REFERENCE_RATIO * reference_mm:.4g} mm"
            ),
        ),
    ]
    return tuple(text for applies, text in found if applies)


def _reservations(groups: Groups, notes: _Notes) -> tuple[str, ...]:
    """Say why nothing may be accepted."""
    frozen = int(groups.frozen.sum())
    found = [
        (
            frozen,
            (
                f"all readings of {frozen} of {len(groups.key)} positions are equal: a frozen "
                "image, or a resolution coarser than the noise; they are left out of the "
                "repeatability"
            ),
        ),
        (
            (groups.flags & int(Flag.untrusted)).any(),
            "the positions were measured with an untrustworthy rig: nothing is accepted",
        ),
    ]
    marked = (text for applies, text in found if applies)
    return (*marked, *_omissions(groups, notes))


def _omissions(groups: Groups, notes: _Notes) -> tuple[str, ...]:
    """Say what was not compared."""
    left_out, missing, lost = len(notes.left_out), len(notes.missing), len(notes.not_measured)
    total = int(groups.count.sum()) + left_out
    found = [
        (left_out, f"{left_out} of {total} readings are flagged and were left out"),
        (missing, f"{missing} readings have no actual position"),
        (lost, f"{lost} of {notes.truths} actual positions have no usable reading"),
    ]
    return tuple(text for applies, text in found if applies)
