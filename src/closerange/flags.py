"""Registry of quality bits: why a row is not to be relied upon.

A flag always means a defect. Tables carry flags as names joined by ``|``; an empty cell
means that nothing is wrong.
"""

from __future__ import annotations

from enum import IntFlag


class Flag(IntFlag):
    """Quality bits of a point, correspondence or position.

    Members are named as they appear in tables, hence in lower case.
    """

    none = 0
    not_found = 1 << 0  # expected, but not in the image
    at_border = 1 << 1  # cut by, or too near to, the image border
    saturated = 1 << 2  # more than 1 % of its pixels at full scale
    blurred = 1 << 3  # edge blur too large for its size
    low_contrast = 1 << 4  # contrast below five times the noise
    poor_fit = 1 << 5  # image residual far above the noise: not the modelled shape
    ambiguous = 1 << 6  # more than one answer fits
    aperture = 1 << 7  # edge along the epipolar segment
    occluded = 1 << 8  # hidden in another view
    outlier = 1 << 9  # contradicts the other points; left out of the fit
    residual = 1 << 10  # the rays miss each other by more than their noise allows
    single_view = 1 << 11  # fewer than two cameras see it
    behind_camera = 1 << 12  # lies behind a camera that is said to see it
    near_parallel = 1 << 13  # the rays are nearly parallel: depth is weak
    outside_volume = 1 << 14  # outside the calibrated measuring volume
    untrusted = 1 << 15  # measured with a rig that was accepted although untrustworthy
    not_converged = 1 << 16  # an iteration stopped before its limit was met
    frozen = 1 << 17  # repeated readings without any variance
    outside_image = 1 << 18  # it, or all of its epipolar segment, lies outside of the image
    no_edge = 1 << 19  # no edge where one was needed
    inconsistent = 1 << 20  # the match, matched back, does not return to it
    beyond_lens = 1 << 21  # a view lies where the lens model has no answer; it was left out


def format_flags(flag: Flag | int) -> str:
    """Write a flag as names joined by ``|``, in registry order.

    Parameters
    ----------
    flag : Flag or int
        Any combination of bits.

    Returns
    -------
    str
        Empty when no bit is set.
    """
    return "|".join(str(bit.name) for bit in Flag if bit in Flag(flag))


def parse_flags(text: str) -> Flag:
    """Read names joined by ``|``.

    Parameters
    ----------
    text : str
        For instance ``"saturated|at_border"``; blanks around names are ignored.

    Returns
    -------
    Flag
        The combined bits.

    Raises
    ------
    ValueError
        If a name is not in the registry; the message lists the known names.
    """
    flag = Flag.none
    for name in filter(None, (part.strip() for part in text.split("|"))):
        if name not in Flag.__members__:
            known = ", ".join(str(bit.name) for bit in Flag)
            raise ValueError(f"unknown flag {name!r}; known flags are {known}")
        flag |= Flag[name]
    return flag
