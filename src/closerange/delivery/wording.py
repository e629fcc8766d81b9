"""Numbers and flags as a reader meets them: with unit, without NaN, in words."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable

from closerange.flags import Flag

DASH = "\u2013"
"""Stands for a value that does not exist; the row's flags say why."""

TIMES = "\u00d7"
"""Between the sides of something."""

FLAG_WORDS: dict[Flag, str] = {
    Flag.not_found: "expected, but not found in the image",
    Flag.at_border: "cut by the image border or too near to it",
    Flag.saturated: "more than 1 % of its pixels are at full scale: lower the exposure",
    Flag.blurred: "its edge is too blurred for its size: focus, or shorten the exposure",
    Flag.low_contrast: "its contrast is below five times the noise: add light",
    Flag.poor_fit: "its image is not of the expected shape",
    Flag.ambiguous: "more than one answer fits",
    Flag.aperture: "the edge runs along the epipolar segment, so its place on it is not fixed",
    Flag.occluded: "hidden in another view",
    Flag.outlier: "contradicts the other points and was left out of the fit",
    Flag.residual: "the rays miss each other by more than their noise allows",
    Flag.single_view: "seen by fewer than two cameras: one ray gives no position",
    Flag.behind_camera: "lies behind a camera that is said to see it",
    Flag.near_parallel: "the rays are nearly parallel: the depth is weak",
    Flag.outside_volume: "outside the calibrated measuring volume: the error may be larger",
    Flag.untrusted: "measured with a calibration that was accepted although untrustworthy",
    Flag.not_converged: "the computation stopped before it settled",
    Flag.frozen: "repeated readings without any variance: was the image really renewed?",
    Flag.outside_image: "it, or all of its epipolar segment, lies outside of the image",
    Flag.no_edge: "no edge where one was needed",
    Flag.inconsistent: "the match, matched back, does not return to it",
    Flag.beyond_lens: "a view lies where the lens model has no answer; it was left out",
}

_MICROMETRES = re.compile(r"(?<=\d )um\b")


def fixed(value: float, digits: int) -> str:
    """Write a number with a fixed count of decimals; a dash for NaN and infinity.

    Parameters
    ----------
    value : float
        Any number.
    digits : int
        Decimals.

    Returns
    -------
    str
        Never ``nan`` and never a negative zero.
    """
    if not math.isfinite(value):
        return DASH
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def significant(value: float, digits: int = 3) -> str:
    """Write a number with some significant digits, without exponent where that is readable."""
    if not math.isfinite(value):
        return DASH
    if value == 0:
        return "0"
    if not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    places = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    return fixed(value, places)


def mm(value_mm: float) -> str:
    """Write millimetres with a resolution of 1 um, without unit (the table's head has it)."""
    return fixed(value_mm, 3)


def micrometres(value_mm: float) -> str:
    """Write a length given in mm as micrometres, without unit."""
    value = 1000 * value_mm
    return fixed(value, 0 if abs(value) >= 10 else 1)


def short_length(value_mm: float) -> str:
    """Write a small length for a sentence: ``4.2 µm``, ``85 µm`` or, from 1 mm on, ``1.25 mm``."""
    if not math.isfinite(value_mm):
        return DASH
    return f"{fixed(value_mm, 2)} mm" if abs(value_mm) >= 1 else f"{micrometres(value_mm)} µm"


def printed(text: str) -> str:
    """Set the sign for micrometres in texts that were written for a terminal."""
    return _MICROMETRES.sub("µm", text)


def three_micrometres(values_mm: Iterable[float]) -> str:
    """Write X, Y and Z for a sentence: ``4.0 µm (X) 4.1 µm (Y) 9.2 µm (Z)``."""
    return " ".join(
        f"{short_length(float(value))} ({axis})"
        for value, axis in zip(values_mm, "XYZ", strict=False)
    )


def percent(share: float) -> str:
    """Write a share as a percentage with one decimal."""
    return DASH if not math.isfinite(share) else f"{fixed(100 * share, 1)} %"


def flag_names(flags: int) -> list[str]:
    """Return the names of the bits that are set, in registry order."""
    return [str(bit.name) for bit in Flag if bit & int(flags)]


def counted(count: int, noun: str, plural: str = "") -> str:
    """Write a count with its noun: ``1 camera``, ``2 cameras``."""
    return f"{count} {noun if count == 1 else plural or noun + 's'}"
