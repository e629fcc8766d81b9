"""Whole images judged before anything is looked for in them."""

from __future__ import annotations

import warnings
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import CloseRangeWarning, DetectionError
from closerange.images.frame import Frame

MIN_STEP = 2.0
"""Grey levels: two neighbouring values and the step between them are rounding, not structure."""

UNIFORM_SIGMAS = 6.0
"""Range of an image without structure, in standard deviations of its noise. The darkest of
four neighbours exceeds the mean by t sigma with the probability Q(t)^4, so in 5 to 200 million
pixels of pure noise the brightest such minimum is 2.0 to 2.4 sigma: a range of 4.1 to 4.8."""

COMB_SHARE = 0.03
"""Share of edge pixels in a comb from which an image counts as interlaced. A disc that moves by
more than its edge blur between two fields gives 0.2 (of its edge only the upright half shows the
comb, and there every second row has the edge elsewhere), by one pixel 0.07 to 0.1;
clean images stay below 0.001. So motion by a pixel is found even if half of the edges belong to a
background at rest."""

MIN_COMB_PX = 16
"""Comb pixels below which nothing is said: a comb of one or two rows would be chance."""

_TILE_PX = 1024
_MAX_SAMPLE = 2**20  # differences that the noise is estimated from


def check_frame(frame: Frame) -> list[str]:
    """Refuse an image without structure and warn of interlacing.

    Parameters
    ----------
    frame : Frame
        The image.

    Returns
    -------
    list of str
        The warnings that were also given, for a report.

    Raises
    ------
    DetectionError
        If the image is uniform: nothing in it rises above the noise.

    Warns
    -----
    CloseRangeWarning
        If the image is made of two fields taken at different moments.
    """
    where = f"{frame.source or 'frame'} (camera {frame.camera!r})"
    noise = noise_level(frame)
    contrast = structure_range(frame)
    limit = max(MIN_STEP, UNIFORM_SIGMAS * noise)
    if contrast <= limit:
        raise DetectionError(
            f"{where}: the image is uniform: {contrast:.0f} grey levels between its darkest and "
            f"brightest spot, noise alone makes up to {limit:.3g} (standard deviation "
            f"{noise:.2g}); mean {frame.pixels.mean():.1f} of {frame.full_scale}",
            remedy="check lens cap, exposure, lighting and that the target is in view",
        )
    return check_interlace(frame)


def check_interlace(frame: Frame) -> list[str]:
    """Warn of an image that is made of two fields taken at different moments.

    Parameters
    ----------
    frame : Frame
        The image.

    Returns
    -------
    list of str
        The warnings that were also given, for a report.

    Warns
    -----
    CloseRangeWarning
        If it is.
    """
    where = f"{frame.source or 'frame'} (camera {frame.camera!r})"
    notes = []
    if (share := comb_share(frame)) > COMB_SHARE:
        notes.append(
            f"{where}: {100 * share:.0f} % of the edge pixels alternate from row to row (limit "
            f"{100 * COMB_SHARE:.0f} %): two interlaced fields of a moving object. Positions will "
            "be wrong by part of the motion; use a progressive camera or a single field"
        )
    for note in notes:
        warnings.warn(note, CloseRangeWarning, stacklevel=2)
    return notes


def noise_level(frame: Frame) -> float:
    """Estimate the standard deviation of the noise of single pixels.

    Parameters
    ----------
    frame : Frame
        The image.

    Returns
    -------
    float
        In grey levels: 1.4826 times the median absolute difference of horizontal neighbours,
        over the square root of two. Edges, being the minority, do not enter. The differences
        are whole numbers, so it comes in steps of 1.05; noise below half a grey level reads
        as 0 or 1.05.
    """
    rows = frame.pixels[:: max(1, frame.pixels.size // _MAX_SAMPLE)].astype(np.int32)
    differences = np.abs(np.diff(rows, axis=1))
    return float(1.4826 * np.median(differences) / np.sqrt(2)) if differences.size else 0.0


def structure_range(frame: Frame) -> float:
    """Return the range of grey values that holds for spots of at least 2 x 2 pixels.

    Parameters
    ----------
    frame : Frame
        The image.

    Returns
    -------
    float
        In grey levels: the maximum of the opening less the minimum of the closing by 2 x 2
        pixels. Single hot or dead pixels do not count, the smallest measurable particle does.
    """
    square = np.ones((2, 2), np.uint8)
    brightest = int(cv2.morphologyEx(frame.pixels, cv2.MORPH_OPEN, square).max())
    darkest = int(cv2.morphologyEx(frame.pixels, cv2.MORPH_CLOSE, square).min())
    return float(brightest - darkest)


def comb_share(frame: Frame) -> float:
    """Return the share of edge pixels that form an interlace comb.

    Between the two fields of an interlaced image a moving upright edge is shifted, so that
    its horizontal gradient g appears in every second row only: g jumps up and down from row
    to row while rows two apart agree. A pixel belongs to a comb if three successive jumps
    alternate in sign, each above the noise, and rows two apart differ by less than half.

    The gradient along the row makes the measure blind to horizontal stripes, however fine:
    they do not change along a row. Textures that alternate in both directions (a checkered
    pattern of single pixels, the mosaic of a colour sensor) cancel, because the same count
    with rows and columns exchanged is subtracted.

    Parameters
    ----------
    frame : Frame
        The image.

    Returns
    -------
    float
        From 0 to 1; 0 if fewer than 16 pixels do.
    """
    # a jump is a difference of four pixels: twice the noise. Three in a row above four times
    # that do not happen by chance
    limit = max(MIN_STEP, 8 * noise_level(frame))
    excess = edges = 0
    height, width = frame.pixels.shape
    for top in range(0, height, _TILE_PX):  # tiles bound the memory for intermediate results
        for left in range(0, width, _TILE_PX):
            tile = frame.pixels[top : top + _TILE_PX, left : left + _TILE_PX]
            combed, found = _comb_count(tile, limit)
            excess += combed - _comb_count(tile.T, limit)[0]
            edges += found
    return excess / edges if excess >= MIN_COMB_PX else 0.0


def _comb_count(pixels: NDArray[Any], limit: float) -> tuple[int, int]:
    """Count comb pixels and edge pixels, with rows as the direction of alternation."""
    if pixels.shape[0] < 4 or pixels.shape[1] < 2:
        return 0, 0
    gradient = np.diff(pixels.astype(np.int32), axis=1)
    jump = np.diff(gradient, axis=0)
    strong = np.abs(jump) > limit
    turns = strong[1:] & strong[:-1] & ((jump[1:] > 0) != (jump[:-1] > 0))
    # jump[1:] + jump[:-1] is the difference of rows two apart
    turns &= 2 * np.abs(jump[1:] + jump[:-1]) < np.abs(jump[1:])
    # a jump above the limit has a gradient above half of it on one of its two rows
    edge = 2 * np.abs(gradient) > limit
    combed = turns[1:] & turns[:-1] & edge[1:-2]
    return int(np.count_nonzero(combed)), int(np.count_nonzero(edge))
