"""Trussell's threshold: half-way between the means of what it separates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.geometry.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class ThresholdReport:
    """A threshold and what else it could have been.

    Attributes
    ----------
    threshold : float
        Pixels above it are bright, all others dark.
    fixed_points : tuple of float
        All values that Trussell's iteration leaves unmoved, ascending.
    between_class_variance : tuple of float
        Otsu's criterion at each fixed point.
    floor : float
        Noise floor below which no fixed point was accepted; -inf without one.
    """

    threshold: float
    fixed_points: tuple[float, ...]
    between_class_variance: tuple[float, ...]
    floor: float = -np.inf


def threshold_report(pixels: NDArray[Any], *, floor: float = -np.inf) -> ThresholdReport:
    """Find all fixed points of Trussell's iteration and choose one.

    Parameters
    ----------
    pixels : ndarray
        Grey values or edge strengths, any real type and shape; NaN is not allowed.
    floor : float, optional
        Noise floor: fixed points below are reported but not chosen; if none is above, the
        floor itself becomes the threshold.

    Returns
    -------
    ThresholdReport
        The chosen threshold and all fixed points.

    Raises
    ------
    InputError
        If there are no pixels.

    Notes
    -----
    The iteration (equations 2.6 and 5.1, each with the factor 1/2 that print lost) often has
    several fixed points, and a start such as the mean of the image or of its corners falls into
    one or another as the noise will. Each fixed point is a stationary point of Otsu's
    between-class variance (doi:10.1109/TSMC.1979.4310076); the largest of them is a property
    of the whole histogram, which noise changes little, and knows no start. Dark and bright
    enter it alike, so both polarities are served.
    """
    values, counts = _histogram(pixels)
    candidates, variances = _fixed_points(values, counts)
    allowed = np.flatnonzero(candidates >= floor)
    if allowed.size:
        threshold = float(candidates[allowed[np.argmax(variances[allowed])]])
    elif np.isfinite(floor):
        threshold = float(floor)
    else:
        threshold = float(values[-1])  # one grey value only: nothing is brighter
    return ThresholdReport(
        threshold, tuple(map(float, candidates)), tuple(map(float, variances)), float(floor)
    )


def fixed_points(pixels: NDArray[Any]) -> tuple[float, ...]:
    """Return all thresholds T that equal half the sum of the means below and above.

    Parameters
    ----------
    pixels : ndarray
        Grey values, any real type and shape.

    Returns
    -------
    tuple of float
        Ascending; empty if there is only one grey value.
    """
    return threshold_report(pixels).fixed_points


def trussell_threshold(pixels: NDArray[Any], start: float | None = None) -> float:
    """Return Trussell's threshold.

    Parameters
    ----------
    pixels : ndarray
        Grey values, any real type and shape.
    start : float, optional
        Iterate from here as the thesis does. Without it, the fixed point of the largest
        between-class variance is taken; see `threshold_report`.

    Returns
    -------
    float
        Pixels above it are bright, all others dark.
    """
    if start is None:
        return threshold_report(pixels).threshold
    values, counts = _histogram(pixels)
    means = _half_sum_of_means(values, counts)
    if means.size == 0:
        return float(values[-1])
    threshold = float(start)
    # The map is monotone and constant between neighbouring grey values, so the iteration walks
    # in one direction and stands still after at most as many steps as there are grey values.
    for _ in range(values.size + 1):
        below = int(np.searchsorted(values, threshold, side="right")) - 1
        following = float(means[np.clip(below, 0, means.size - 1)])
        if following == threshold:
            break
        threshold = following
    return threshold


def _histogram(pixels: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Return grey values that occur and how often."""
    flat = np.asarray(pixels).ravel()
    if flat.size == 0:
        raise InputError("no pixels to threshold", remedy="give an image of at least one pixel")
    if flat.dtype in (np.uint8, np.uint16):
        counts = np.bincount(flat)
        values = np.flatnonzero(counts)
        return values.astype(np.float64), counts[values].astype(np.float64)
    values, counts = np.unique(flat, return_counts=True)
    if not np.isfinite(values).all():
        raise InputError("pixels are not finite", remedy="remove NaN and infinite values first")
    return values.astype(np.float64), counts.astype(np.float64)


def _half_sum_of_means(values: FloatArray, counts: FloatArray) -> FloatArray:
    """T' for T from each grey value up to the next: (mean of values <= T + mean above) / 2."""
    number, total = np.cumsum(counts), np.cumsum(counts * values)
    below = total[:-1] / number[:-1]
    above = (total[-1] - total[:-1]) / (number[-1] - number[:-1])
    return np.asarray((below + above) / 2)


def _fixed_points(values: FloatArray, counts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return fixed points and their between-class variance."""
    following = _half_sum_of_means(values, counts)
    fixed = np.flatnonzero((following >= values[:-1]) & (following < values[1:]))
    share = np.cumsum(counts)[fixed] / counts.sum()
    below = np.cumsum(counts * values)[fixed] / np.cumsum(counts)[fixed]
    gap = 2 * (following[fixed] - below)  # mean above - mean below
    return following[fixed], np.asarray(share * (1 - share) * gap**2)
