"""Binary images packed into 64-bit words: 8 x 8 pixels at once are compared by AND and counted."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import BoolArray

Words = NDArray[np.uint64]

SIDE = 8
"""Side of a block. On the edge images of the shared scenes an element of 15 x 15 px has edges in
2.7 blocks of 8 x 8, 3.3 of 4 x 16 and 4.0 of 3 x 21: a line fills a square block best."""

_COUNT = getattr(np, "bitwise_count", None)  # NumPy 2 and later


def pack_blocks(mask: BoolArray, margin: int) -> Words:
    """Pack the block to the lower right of every pixel into one word.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Binary image; beyond it nothing is set.
    margin : int
        Pixels to add on all sides.

    Returns
    -------
    ndarray of uint64, shape (H + 2 margin, W + 2 margin)
        Bit 8 r + c of the word at (y, x) is the pixel (y + r, x + c), without the margin.

    Notes
    -----
    Six shifts in all: pairs of columns, then of pairs, then of fours; then rows likewise.
    """
    height, width = mask.shape
    packed: NDArray[Any] = np.zeros((height + 2 * margin, width + 2 * margin), np.uint8)
    packed[margin : margin + height, margin : margin + width] = mask
    for step in (1, 2, 4):
        packed[:, :-step] |= packed[:, step:] << np.uint8(step)
    for step, wider in ((1, np.uint16), (2, np.uint32), (4, np.uint64)):
        packed = packed.astype(wider)
        packed[:-step] |= packed[step:] << wider(SIDE * step)
    return packed


def bits_to_words(bits: NDArray[np.uint8]) -> Words:
    """Pack bytes of 0 and 1, 64 to a word, the first into the lowest bit.

    Parameters
    ----------
    bits : ndarray of uint8, shape (N, 64 K)
        Blocks as `pack_blocks` counts their pixels.

    Returns
    -------
    ndarray of uint64, shape (N, K)
        One word a block.
    """
    packed = np.packbits(bits, axis=1, bitorder="little")
    return np.asarray(packed.view("<u8"), np.uint64)


def count_bits(words: Words) -> NDArray[np.uint8]:
    """Count the bits that are set in each word.

    Parameters
    ----------
    words : ndarray of uint64
        Any shape.

    Returns
    -------
    ndarray of uint8
        Same shape, 0 to 64.
    """
    if _COUNT is None:
        return count_bits_by_halves(words)
    return np.asarray(_COUNT(words), np.uint8)


def count_bits_by_halves(words: Words) -> NDArray[np.uint8]:
    """Count as `count_bits` does, for NumPy below 2: sums of 2, 4 and 8 neighbouring bits.

    Parameters
    ----------
    words : ndarray of uint64
        Any shape.

    Returns
    -------
    ndarray of uint8
        Same shape.
    """
    one, two, four, last = (np.uint64(shift) for shift in (1, 2, 4, 56))
    pairs = words - ((words >> one) & np.uint64(0x5555555555555555))
    fours = np.uint64(0x3333333333333333)
    pairs = (pairs & fours) + ((pairs >> two) & fours)
    pairs = (pairs + (pairs >> four)) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.asarray((pairs * np.uint64(0x0101010101010101)) >> last, np.uint8)
