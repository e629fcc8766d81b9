"""Scanning packed elements over image 2, and choosing among the places."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import BoolArray, IntArray
from closerange.matching.literal_band import Bands
from closerange.matching.literal_element import MappedElements
from closerange.matching.literal_words import Words, count_bits, pack_blocks

Hits = NDArray[np.uint16]

TIE_PX = 1.5
"""Places with equally few missing pixels that lie farther from the chosen one than its eight
neighbours are other answers, not the same one to within a pixel."""

_CHUNK = 16384
"""Places that are scored at once: their words, 128 kB, stay in the cache of one core."""


class PackedImage:
    """Image 2 as words, with a margin as wide as elements reach.

    Parameters
    ----------
    mask : ndarray of bool, shape (H, W)
        Edge pixels of image 2; beyond it there are none, so what an element has there is missing.
    """

    def __init__(self, mask: BoolArray) -> None:
        self._mask = mask
        self._margin = -1
        self._words: Words = np.zeros((0, 0), np.uint64)

    def words(self, reach: int) -> tuple[Words, int]:
        """Return the words and their margin, which is at least the reach."""
        if reach > self._margin:
            self._margin = reach
            self._words = pack_blocks(self._mask, reach)
        return self._words, self._margin

    def scan(self, elements: MappedElements, places: Bands) -> Hits:
        """Count the pixels of each element that are present at each of its places.

        Parameters
        ----------
        elements : MappedElements
            M elements.
        places : Bands
            Their neighbourhoods, at most L places each.

        Returns
        -------
        ndarray of uint16, shape (M, L)
            0 at places that do not count.
        """
        words, margin = self.words(elements.reach)
        width = words.shape[1]
        flat = words.ravel()
        corner = (places.row + margin) * np.int32(width) + (places.column + margin)
        shift = elements.down * np.int32(width) + elements.across
        hits = np.zeros(places.row.shape, np.uint16)
        # with the elements of most blocks first, those that have a block more are a beginning
        order = np.argsort(-elements.blocks, kind="stable")
        step = max(_CHUNK // places.row.shape[1], 1)
        for first in range(0, len(order), step):
            rows = order[first : first + step]
            hits[rows] = _counted(
                flat, corner[rows], shift[rows], elements.word[rows], elements.blocks[rows]
            )
        hits *= places.valid
        return hits

    def scan_all(self, elements: MappedElements, point: int) -> Hits:
        """Count the pixels of one element that are present at each place of the whole image.

        Parameters
        ----------
        elements : MappedElements
            Elements.
        point : int
            Which of them.

        Returns
        -------
        ndarray of uint16, shape (H, W)
            For every pixel of image 2.
        """
        words, margin = self.words(elements.reach)
        height, width = self._mask.shape
        hits = np.zeros((height, width), np.uint16)
        for block in range(int(elements.blocks[point])):
            top = margin + int(elements.down[point, block])
            left = margin + int(elements.across[point, block])
            seen = words[top : top + height, left : left + width] & elements.word[point, block]
            hits += count_bits(seen)
        return hits


def _counted(
    flat: Words,
    corner: NDArray[np.int32],
    shift: NDArray[np.int32],
    word: Words,
    blocks: IntArray,
) -> Hits:
    """Count over blocks; rows have descending numbers of blocks."""
    hits = np.zeros(corner.shape, np.uint16)
    for block in range(int(blocks[0])):
        rows = int(np.searchsorted(-blocks, -block, side="left"))
        place = corner[:rows] + shift[:rows, block, None]
        # all places lie in the margin at worst: clipping only spares NumPy its check
        seen = flat.take(place, mode="clip")
        seen &= word[:rows, block, None]
        hits[:rows] += count_bits(seen)
    return hits


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """The best place of each point; M points.

    Attributes
    ----------
    place : ndarray of int, shape (M,)
        Index into the neighbourhood.
    hits, ties : ndarray of int, shape (M,)
        Pixels present there, and number of places with as many.
    spread : ndarray of bool, shape (M,)
        Whether one of them is farther than `TIE_PX`.
    """

    place: IntArray
    hits: IntArray
    ties: IntArray
    spread: BoolArray


def choose_places(hits: Hits, places: Bands) -> Chosen:
    """Choose the place with most pixels present, the middle one of several.

    Parameters
    ----------
    hits : ndarray, shape (M, L)
        Of `PackedImage.scan`.
    places : Bands
        Neighbourhoods.

    Returns
    -------
    Chosen
        Of T equal places, in the order of the neighbourhood (from near to far along the ray),
        number (T + 1) // 2: the thesis names no rule, and the middle of a run of neighbours is
        the least wrong.
    """
    most = hits.max(axis=1, initial=0)
    equal = (hits == most[:, None]) & (most > 0)[:, None]
    ties = np.count_nonzero(equal, axis=1)
    place = np.argmax(equal, axis=1) if equal.shape[1] else np.zeros(len(hits), np.int64)
    spread = np.zeros(len(hits), np.bool_)
    rows = np.flatnonzero(ties > 1)
    if len(rows):
        point, index = np.nonzero(equal[rows])
        start = np.cumsum(ties[rows]) - ties[rows]
        middle = index[start + (ties[rows] - 1) // 2]
        place[rows] = middle
        at = rows[point]
        away = np.hypot(
            places.column[at, index] - places.column[rows, middle][point],
            places.row[at, index] - places.row[rows, middle][point],
        )
        spread[rows] = np.maximum.reduceat(away, start) > TIE_PX
    return Chosen(place, most.astype(np.int64), ties, spread)
