"""Costs of a whole image along its epipolar segments, smoothed along lines of pixels."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

UNIT = 64
"""Cost of a window that explains nothing: whole numbers of one byte are four times as fast."""

SLANT = 26
"""Price of a step of one plane between neighbours, two fifths of such a window: less than what an
ordinary window lacks of a perfect one, as surfaces are slanted everywhere."""

JUMP = 128
"""Price of any longer step, two such windows: a surface that ends must explain at least two pixels
better. With it no sum exceeds 218, which still is one byte."""


def smoothed(cost: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Sum the least costs of all ways that lead to each pixel and plane along rows and columns.

    Semi-global matching (doi:10.1109/TPAMI.2007.1166): along each line that ends in a pixel,
    neighbours prefer the same plane or the next one. Edges and textures alike tell their
    neighbours which of several similar places is the one.

    Parameters
    ----------
    cost : ndarray of uint8, shape (H, W, K)
        0 for a perfect fit to `UNIT`.

    Returns
    -------
    ndarray of uint16, shape (H, W, K)
        Over four directions; each holds the pixel's own cost once.
    """
    total = np.zeros(cost.shape, dtype=np.uint16)
    height, width, _ = cost.shape
    for lines in (range(height), range(height - 1, -1, -1)):
        _pass(lines, lambda line: cost[line], lambda line: total[line])
    for lines in (range(width), range(width - 1, -1, -1)):
        _pass(lines, lambda line: cost[:, line], lambda line: total[:, line])
    return total


def _pass(
    lines: range,
    cost: Callable[[int], NDArray[np.uint8]],
    total: Callable[[int], NDArray[np.uint16]],
) -> None:
    """Go over the image line by line, all pixels of a line at once."""
    before: NDArray[np.uint8] | None = None
    for line in lines:
        here = np.ascontiguousarray(cost(line))
        if before is not None:
            least = before.min(axis=1, keepdims=True)
            way = np.minimum(before, least + np.uint8(JUMP))
            np.minimum(way[:, 1:], before[:, :-1] + np.uint8(SLANT), out=way[:, 1:])
            np.minimum(way[:, :-1], before[:, 1:] + np.uint8(SLANT), out=way[:, :-1])
            way -= least
            way += here
            here = way
        part = total(line)
        part += here
        before = here
