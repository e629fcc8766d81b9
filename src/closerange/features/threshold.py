"""Trussell's threshold: half-way between the means of what it separates."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError, SchemaError
from closerange.geometry.arrays import FloatArray

NOISE_CEILING = 0.61
"""Blur-minimum strength, in standard deviations of the pixels' noise, that one pixel in a thousand
of pure white noise exceeds (9 million pixels drawn; 0.607). An image of parts has an edge at one
pixel in fifty or so: noise then makes at most a few per cent of what is called an edge."""

_NAMES = ("camera", "placement", "reading")


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
    image : str
        What was thresholded.
    """

    threshold: float
    fixed_points: tuple[float, ...]
    between_class_variance: tuple[float, ...]
    floor: float = -np.inf
    image: str = "grey values"

    def in_units(self, factor: float, offset: float = 0.0, *, image: str) -> ThresholdReport:
        """Return the report of ``factor * values + offset``.

        Parameters
        ----------
        factor, offset : float
            A negative factor exchanges dark and bright.
        image : str
            What these values are.

        Returns
        -------
        ThresholdReport
            Fixed points ascending again.
        """
        order = 1 if factor > 0 else -1
        return ThresholdReport(
            factor * self.threshold + offset,
            tuple(factor * point + offset for point in self.fixed_points)[::order],
            tuple(factor**2 * variance for variance in self.between_class_variance)[::order],
            factor * self.floor + offset if np.isfinite(self.floor) else self.floor,
            image,
        )


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


def edge_threshold(strength: NDArray[Any], *, noise: float) -> ThresholdReport:
    """Choose Trussell's threshold for an edge-strength image by a start rule that noise survives.

    Parameters
    ----------
    strength : ndarray
        Edge strengths of `closerange.features.edge_operators.blur_minimum` with its blur of
        3 x 3 px, rounded or not; what is below 0 counts as 0.
    noise : float
        Standard deviation of the noise of single pixels of the image that they come from; see
        `closerange.features.edge_operators.pixel_noise`.

    Returns
    -------
    ThresholdReport
        The lowest fixed point that is not below the noise's floor; the floor itself if there is
        none. All fixed points, and the floor, are reported.

    Raises
    ------
    InputError
        If there are no pixels, some are NaN, or the noise is not a finite number of 0 or more.

    Notes
    -----
    Nearly all pixels of an edge-strength image are noise. From about 5 grey levels of noise
    the noise has a fixed point of its own, which splits its weaker from its stronger half; the
    thesis' start, a mean of the image, lies below and ends there: a quarter of all pixels then
    count as edges. So the iteration starts at a floor that the noise does not reach, and what
    lies below is not accepted. The LOWEST fixed point above is taken, not the one of the
    largest between-class variance: above the floor everything is edge, and a higher fixed point
    would only part strong edges (highlights) from faint ones.
    """
    if not (np.isfinite(noise) and noise >= 0):
        raise InputError(f"the noise is {noise}", remedy="give a finite number of grey levels")
    floor = NOISE_CEILING * noise
    levels, step = _levels(strength)
    report = threshold_report(levels)
    points = tuple(step * point for point in report.fixed_points)
    variances = tuple(step**2 * variance for variance in report.between_class_variance)
    threshold = min((point for point in points if point >= floor), default=floor)
    return ThresholdReport(threshold, points, variances, floor)


Thresholds: TypeAlias = Mapping[tuple[str, str, str], ThresholdReport]
"""By camera, placement and reading."""


def threshold_documents(thresholds: Thresholds) -> list[dict[str, Any]]:
    """Return the thresholds of images JSON-ready; a floor that there is none becomes None."""
    return [
        {
            **dict(zip(_NAMES, key, strict=True)),
            "image": report.image,
            "threshold": report.threshold,
            "fixed_points": list(report.fixed_points),
            "between_class_variance": list(report.between_class_variance),
            "floor": report.floor if np.isfinite(report.floor) else None,
        }
        for key, report in thresholds.items()
    ]


def thresholds_from(documents: Iterable[Mapping[str, Any]]) -> Thresholds:
    """Rebuild thresholds from `threshold_documents`.

    Parameters
    ----------
    documents : iterable of mapping
        Parsed JSON.

    Returns
    -------
    dict
        By camera, placement and reading.

    Raises
    ------
    SchemaError
        If they are no such documents.
    """
    camera, placement, reading = _NAMES
    try:
        return {
            (str(entry[camera]), str(entry[placement]), str(entry[reading])): ThresholdReport(
                float(entry["threshold"]),
                tuple(float(point) for point in entry["fixed_points"]),
                tuple(float(variance) for variance in entry["between_class_variance"]),
                -np.inf if entry["floor"] is None else float(entry["floor"]),
                str(entry["image"]),
            )
            for entry in documents
        }
    except (KeyError, TypeError, ValueError) as error:
        raise SchemaError(
            f"thresholds: malformed document ({type(error).__name__}: {error})",
            remedy="write the result again with this version of the program",
        ) from error


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


def _levels(strength: NDArray[Any]) -> tuple[NDArray[Any], float]:
    """Return strengths as whole numbers, which are counted instead of sorted, and their step.

    The step is 1/65535 of the largest, far below any noise.
    """
    clipped = np.maximum(strength, 0)
    if clipped.dtype in (np.uint8, np.uint16):
        return clipped, 1.0
    largest = float(clipped.max(initial=0))
    if not np.isfinite(largest):
        raise InputError(
            "edge strengths are not finite", remedy="remove NaN and infinite values first"
        )
    step = largest / 65535 or 1.0
    return np.rint(clipped * (1 / step)).astype(np.uint16), step


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
