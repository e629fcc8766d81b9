"""Structuring elements of the literal matcher: cut from image 1, carried into view 2, packed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.features.structuring import StructuringElement
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.literal_words import SIDE, Words, bits_to_words, count_bits
from closerange.rig.camera import Camera

SHAPES = ("square", "disc", "cross")

_COVERED = 65536
"""Pixels of footprints that are looked up at once, which the cache holds."""

_BITS = 2**19
"""Bytes of unpacked blocks that are held at once: the cache holds half a megabyte."""


def footprint(side_px: int, shape: str = "square") -> BoolArray:
    """Return which pixels around a candidate belong to its element.

    Parameters
    ----------
    side_px : int
        N, odd, 3 or more.
    shape : {"square", "disc", "cross"}, optional
        All N x N pixels as in the thesis; those within (N - 1) / 2 of the centre; or the middle
        third of the rows and of the columns.

    Returns
    -------
    ndarray of bool, shape (N, N)
        True inside.

    Raises
    ------
    InputError
        If the size or the shape is none.
    """
    check_side(side_px)
    if shape not in SHAPES:
        raise InputError(
            f"an element of shape {shape!r}", remedy=f"choose one of {', '.join(SHAPES)}"
        )
    if shape == "disc":
        return StructuringElement.disc(side_px // 2).mask()[0]
    box = np.ones((side_px, side_px), np.bool_)
    if shape == "cross":
        across = np.abs(np.arange(side_px) - side_px // 2) <= max(side_px // 6, 1)
        box &= across[:, None] | across
    return box


def strip_footprint(side_px: int, tangent: tuple[float, float]) -> BoolArray:
    """Return the pixels beside the straight line through a candidate along its edge.

    Parameters
    ----------
    side_px : int
        Length N, odd, 3 or more.
    tangent : (float, float)
        Unit vector x, y along the edge.

    Returns
    -------
    ndarray of bool, shape (N, N)
        Within (N - 1) / 2 of the centre along the line and a sixth of N across it: the strip has
        a third of the square's pixels, as the cross has five ninths.

    Raises
    ------
    InputError
        If the size is none.
    """
    check_side(side_px)
    reach = np.arange(side_px) - side_px // 2
    along = tangent[0] * reach + tangent[1] * reach[:, None]
    across = tangent[0] * reach[:, None] - tangent[1] * reach
    inside = (np.abs(along) <= side_px // 2 + 1e-9) & (np.abs(across) <= max(side_px / 6, 1.0))
    return np.asarray(inside)


def check_side(side_px: int, *, largest_px: int | None = None) -> None:
    """Refuse elements without a centre pixel, without surroundings, or larger than an image."""
    if largest_px is not None and side_px > largest_px:
        raise InputError(
            f"an element of {side_px} x {side_px} px in an image of {largest_px} px",
            remedy="choose a smaller one: 15 px for edge points, 59 px for centroids",
        )
    if side_px != int(side_px) or side_px < 3 or side_px % 2 == 0:
        raise InputError(
            f"an element of {side_px} x {side_px} px",
            remedy="give an odd whole number from 3 on: the candidate is the pixel in the middle",
        )


def farthest_plane(camera_1: Camera, camera_2: Camera, volume_mm: FloatArray) -> tuple[int, float]:
    """Return the face of the volume that lies farthest from the cameras.

    Parameters
    ----------
    camera_1, camera_2 : Camera
        Views.
    volume_mm : ndarray, shape (2, 3)
        Lower and upper corner; infinite on axes without limits.

    Returns
    -------
    axis : int
        World axis (0, 1, 2) along which both cameras look most nearly, of those with two limits.
    offset_mm : float
        Coordinate of the face: Z_upper of the thesis for cameras that look along Z.
    """
    forward = camera_1.camera_from_world.rotation[2] + camera_2.camera_from_world.rotation[2]
    limited = np.isfinite(volume_mm).all(axis=0)
    axis = int(np.argmax(np.where(limited, np.abs(forward), -1.0)))
    return axis, float(volume_mm[1 if forward[axis] > 0 else 0, axis])


@dataclass(frozen=True, slots=True, eq=False)
class MappedElements:
    """Elements in view 2, packed; M points, at most K blocks each.

    Attributes
    ----------
    word, down, across : ndarray, shape (M, K)
        Pixels of each block that has any, and the block's place from the candidate; the word is 0
        beyond the last.
    blocks, pixels : ndarray of int, shape (M,)
        Number of blocks, and of different pixels of each element.
    lowest, highest : ndarray of int, shape (M, 2)
        Smallest and largest (row, column) from the candidate.
    oversized : ndarray of bool, shape (M,)
        Whether a pixel fell farther from the candidate than image 2 is long; such an element has
        been emptied: it could not be compared.
    """

    word: Words
    down: NDArray[np.int32]
    across: NDArray[np.int32]
    blocks: IntArray
    pixels: IntArray
    lowest: NDArray[np.int32]
    highest: NDArray[np.int32]
    oversized: BoolArray

    @property
    def reach(self) -> int:
        """Farthest that a block reaches from its candidate, in rows or columns."""
        farthest = max(int(np.abs(edge).max(initial=0)) for edge in (self.lowest, self.highest))
        return farthest + 2 * SIDE


class EdgePixels:
    """The edge pixels of image 1, each carried into view 2 once, whatever elements it is part of.

    Parameters
    ----------
    camera_1, camera_2 : Camera
        Views.
    mask : ndarray of bool, shape (H, W)
        Edge pixels of image 1.
    plane : (int, float)
        See `farthest_plane`.

    Notes
    -----
    Equations (5.4) and (5.3).
    """

    def __init__(
        self, camera_1: Camera, camera_2: Camera, mask: BoolArray, plane: tuple[int, float]
    ) -> None:
        self._cameras, self._plane = (camera_1, camera_2), plane
        self._number = np.full(mask.shape, -1, np.int32)
        row, column = np.nonzero(mask)
        there = self.carried(camera_1.directions(np.column_stack([column, row])))
        # a pixel that cannot be carried is no part of any element
        known = all_finite(there, 1)
        self._across, self._down = np.ascontiguousarray(there[known].T)
        self._number[row[known], column[known]] = np.arange(len(self._down), dtype=np.int32)

    def carried(self, direction: FloatArray) -> FloatArray:
        """Return where rays of camera 1, shape (M, 3), meet the plane, in view 2, or NaN."""
        axis, offset = self._plane
        first, second = self._cameras
        centre = first.centre_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offset - centre[axis]) / direction[:, axis]
        distance = np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)
        return second.project(centre + distance[:, None] * direction)

    def elements(self, pixel: IntArray, centre_px: FloatArray, inside: BoolArray) -> MappedElements:
        """Cut the elements of candidates and carry them into view 2.

        Parameters
        ----------
        pixel : ndarray of int, shape (M, 2)
            Candidates x, y, in the image.
        centre_px : ndarray, shape (M, 2)
            Where `carried` puts them; an element is empty where this is NaN.
        inside : ndarray of bool, shape (N, N)
            Footprint.

        Returns
        -------
        MappedElements
            M elements. Places are rounded to whole pixels from the candidate's; those that fall
            together are one. Pixels beyond the image do not exist.
        """
        point, number = self._covered(pixel, inside)
        # rows and columns apart: NumPy is slow along an axis of two
        away = [
            side.take(number) - centre_px[:, axis].take(point)
            for axis, side in ((1, self._down), (0, self._across))
        ]
        oversized = self._oversized(point, away, len(pixel))
        kept = ~(oversized | ~all_finite(centre_px, 1))[point]
        if not kept.all():
            point, away = point[kept], [side[kept] for side in away]
        offset = [np.rint(side).astype(np.int32) for side in away]
        lowest, highest = _extents(point, offset, len(pixel))
        corner = [low.take(point) for low in lowest.T]
        place = (offset[0] - corner[0], offset[1] - corner[1])
        word, across = _packed(
            point, place, np.max(highest - lowest, axis=0, initial=0), len(pixel)
        )
        return _without_empty(word, across, (lowest, highest), oversized)

    def _oversized(self, point: NDArray[np.intp], away: list[FloatArray], count: int) -> BoolArray:
        """Mark the elements with a pixel farther from the candidate than image 2 is long."""
        longest = max(self._cameras[1].size_px)
        oversized = np.zeros(count, np.bool_)
        for side in away:
            oversized[point[np.abs(side) > longest]] = True
        return oversized

    def _covered(
        self, pixel: IntArray, inside: BoolArray
    ) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
        """Return pairs of candidate and edge pixel in its footprint, by candidate."""
        reach = len(inside) // 2
        padded = np.pad(self._number, reach, constant_values=-1)
        row, column = np.nonzero(inside)
        window = (row * padded.shape[1] + column).astype(np.int32)
        corner = (pixel[:, 1] * padded.shape[1] + pixel[:, 0]).astype(np.int32)
        numbers = padded.ravel()
        edge = numbers >= 0
        point, number = [np.zeros(0, np.intp)], [np.zeros(0, np.int32)]
        step = max(_COVERED // len(window), 1)
        for first in range(0, len(corner), step):
            looked = (corner[first : first + step, None] + window).ravel()
            place = np.flatnonzero(edge.take(looked))
            point.append(first + place // len(window))
            number.append(numbers.take(looked.take(place)))
        return np.concatenate(point), np.concatenate(number)


def _extents(
    point: NDArray[np.intp], offset: list[NDArray[np.int32]], count: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the smallest and the largest (row, column) of each element; 0 without any."""
    lowest, highest = np.zeros((count, 2), np.int32), np.zeros((count, 2), np.int32)
    if len(point):
        start = np.flatnonzero(np.diff(point, prepend=-1))
        for axis, side in enumerate(offset):
            lowest[point[start], axis] = np.minimum.reduceat(side, start)
            highest[point[start], axis] = np.maximum.reduceat(side, start)
    return lowest, highest


def _packed(
    point: NDArray[np.intp],
    place: tuple[NDArray[np.int32], NDArray[np.int32]],
    extent: NDArray[np.int32],
    count: int,
) -> tuple[Words, int]:
    """Pack pixels, counted from each element's own corner; return the blocks in a row too."""
    down, across = (extent // SIDE + 1).tolist()
    row, column = place
    block = (row >> 3) * np.int32(across) + (column >> 3)
    bit = (block << 6) + ((row & 7) << 3) + (column & 7)
    word = np.zeros((count, down * across), np.uint64)
    piece = max(_BITS // (64 * down * across), 1)
    for first in range(0, count, piece):
        low, high = np.searchsorted(point, (first, first + piece))
        canvas = np.zeros((min(piece, count - first), down * across * 64), np.uint8)
        inside = (point[low:high] - first) * canvas.shape[1] + bit[low:high]
        canvas.ravel()[inside] = 1
        word[first : first + piece] = bits_to_words(canvas)
    return word, across


def _without_empty(
    word: Words,
    across: int,
    ends: tuple[NDArray[np.int32], NDArray[np.int32]],
    oversized: BoolArray,
) -> MappedElements:
    """Keep the blocks that have pixels, moved to the front of each row."""
    lowest, highest = ends
    point, block = np.nonzero(word)
    blocks = np.bincount(point, minlength=len(word))
    slot = np.arange(len(point)) - np.repeat(np.cumsum(blocks) - blocks, blocks)
    shape = (len(word), int(blocks.max(initial=0)))
    kept = np.zeros(shape, np.uint64)
    rows, columns = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
    kept[point, slot] = word[point, block]
    rows[point, slot] = lowest[point, 0] + SIDE * (block // across)
    columns[point, slot] = lowest[point, 1] + SIDE * (block % across)
    pixels = count_bits(kept).sum(axis=1, dtype=np.int64)
    return MappedElements(kept, rows, columns, blocks, pixels, lowest, highest, oversized)
