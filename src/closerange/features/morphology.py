"""Erosion, dilation, residues, opening and closing, exactly as chapter 4 of the thesis says.

Which set is reflected: in the erosion (equations 4.2, 4.5) the element is laid on the image as it
is, at x + b; in the dilation (4.4, 4.6) it is laid on reflected, at c - b, so that the dilation of
a single pixel is the element itself. Opening and closing are built from these two, therefore hold
their laws for every element, whatever its origin.

Outside the image. By default what lies outside is ``neutral``: it takes no part in the minimum or
maximum. A pixel whose whole element lies outside gets the largest value of the type from an
erosion and the least from a dilation. With ``background`` the outside holds 0 (False), which
makes the binary operations those of the set of the image's own pixels.
"""

from __future__ import annotations

from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.features.structuring import StructuringElement
from closerange.geometry.arrays import IntArray

Outside = Literal["neutral", "background"]
Pixels = NDArray[Any]

_BY_OPENCV = (np.uint8, np.uint16, np.int16, np.float32, np.float64)


def erode(image: Pixels, element: StructuringElement, *, outside: Outside = "neutral") -> Pixels:
    """Erode: e(r, c) = min over (i, j) of f(r + i, c + j) - b(i, j).

    Equation 4.5; for sets 4.2, {x : x + b in A for every b in B}.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Binary (bool) or grey (uint8, uint16, int16, float32, float64) image f.
    element : StructuringElement
        b; for a binary image a flat one.
    outside : str, optional
        ``neutral`` or ``background``; see the module.

    Returns
    -------
    ndarray, shape (H, W)
        Of the image's type for a flat element, else float64, so that nothing is cut off.

    Raises
    ------
    InputError
        If the image is of another form or has NaN, or a binary image meets an element with
        heights.
    """
    return _filtered(image, element, outside, erosion=True)


def dilate(image: Pixels, element: StructuringElement, *, outside: Outside = "neutral") -> Pixels:
    """Dilate: d(r, c) = max over (i, j) of f(r - i, c - j) + b(i, j).

    Equation 4.6; for sets 4.4, {a + b : a in A, b in B}. The thesis' dilation is defined on the
    domain of f dilated by that of b; here it is kept on the domain of f.

    Parameters
    ----------
    image, element, outside
        As for `erode`.

    Returns
    -------
    ndarray, shape (H, W)
        As for `erode`.

    Raises
    ------
    InputError
        As `erode`.
    """
    return _filtered(image, element, outside, erosion=False)


def opening(image: Pixels, element: StructuringElement, *, outside: Outside = "neutral") -> Pixels:
    """Open: erode, then dilate. Removes what the element does not fit into.

    Parameters
    ----------
    image, element, outside
        As for `erode`.

    Returns
    -------
    ndarray, shape (H, W)
        Nowhere above the image.

    Raises
    ------
    InputError
        As `erode`.
    """
    return dilate(erode(image, element, outside=outside), element, outside=outside)


def closing(image: Pixels, element: StructuringElement, *, outside: Outside = "neutral") -> Pixels:
    """Close: dilate, then erode. Fills what the element does not fit into.

    Parameters
    ----------
    image, element
        As for `erode`.
    outside : str, optional
        As for `erode`. With ``background`` what touches the image's border is eroded from
        there, because the dilation is not kept beyond the image.

    Returns
    -------
    ndarray, shape (H, W)
        Nowhere below the image (with ``neutral``).

    Raises
    ------
    InputError
        As `erode`.
    """
    return erode(dilate(image, element, outside=outside), element, outside=outside)


def erosion_residue(image: Pixels, element: StructuringElement) -> Pixels:
    """Subtract the erosion from the image: f - e, as in equation 4.7.

    Parameters
    ----------
    image, element
        As for `erode`.

    Returns
    -------
    ndarray, shape (H, W)
        Signed (uint8 gives int16, uint16 and int16 give int32): where the element does not
        hold its origin the residue of a pixel darker than all others is negative. For a binary
        image the set difference of image and erosion.

    Raises
    ------
    InputError
        As `erode`.
    """
    return _difference(image, erode(image, element))


def dilation_residue(image: Pixels, element: StructuringElement) -> Pixels:
    """Subtract the image from the dilation: d - f, as in equation 4.8.

    Parameters
    ----------
    image, element
        As for `erode`.

    Returns
    -------
    ndarray, shape (H, W)
        Signed, as for `erosion_residue`: an isolated bright pixel has a negative residue if the
        element does not hold its origin. For a binary image the set difference of dilation and
        image.

    Raises
    ------
    InputError
        As `erode`.
    """
    return _difference(dilate(image, element), image)


def _difference(larger: Pixels, smaller: Pixels) -> Pixels:
    if larger.dtype == bool:
        return larger & ~smaller
    wide = np.result_type(larger, smaller, np.int16)  # one step wider than unsigned
    if larger.dtype == np.int16:
        wide = np.dtype(np.int32)
    return np.subtract(larger, smaller, dtype=wide)


def _filtered(
    image: Pixels, element: StructuringElement, outside: Outside, *, erosion: bool
) -> Pixels:
    """Check, then take the minimum or maximum over the element as it lies on the image."""
    _check(image, element, outside)
    # the dilation is the maximum over the reflected element, laid on at c - b
    laid = element if erosion else element.reflected
    if not laid.flat:
        return _non_flat(image, laid, outside, erosion=erosion)
    if image.dtype == bool:
        return _flat(image.astype(np.uint8), laid.offsets, outside, erosion=erosion) > 0
    return _flat(image, laid.offsets, outside, erosion=erosion)


def _check(image: Pixels, element: StructuringElement, outside: Outside) -> None:
    if image.ndim != 2 or image.size == 0 or image.dtype not in (bool, *_BY_OPENCV):
        raise InputError(
            f"an image of {image.dtype} and shape {image.shape} cannot be eroded or dilated",
            remedy="give a two-dimensional image of bool, uint8, uint16, int16 or floats",
        )
    if image.dtype.kind == "f" and np.isnan(image).any():
        raise InputError("pixels are NaN", remedy="replace them first: a minimum has no NaN")
    if image.dtype == bool and not element.flat:
        raise InputError(
            "a binary image and a structuring element with heights",
            remedy="use a flat element, or a grey image",
        )
    if outside not in ("neutral", "background"):
        raise InputError(f"outside is {outside!r}", remedy="write 'neutral' or 'background'")


def _extreme(dtype: np.dtype[Any], *, erosion: bool) -> float:
    """Return the value that no minimum (erosion) or maximum takes from a type."""
    if dtype.kind == "f":
        return np.inf if erosion else -np.inf
    limits = np.iinfo(dtype)
    return int(limits.max) if erosion else int(limits.min)


def _flat(image: Pixels, offsets: IntArray, outside: Outside, *, erosion: bool) -> Pixels:
    """Take the extreme of f(r + i, c + j); outside the image f is a constant."""
    fill = _extreme(image.dtype, erosion=erosion) if outside == "neutral" else 0
    # what is outside wherever the element is laid on may be far away: it finds the fill only
    met = (np.abs(offsets) < image.shape).all(axis=1)
    if not met.any():
        return np.full_like(image, fill)
    result = _by_opencv(image, offsets[met], fill, erosion=erosion)
    if met.all() or outside == "neutral":
        return result
    extreme = np.minimum if erosion else np.maximum
    return np.asarray(extreme(result, image.dtype.type(fill)))


def _by_opencv(image: Pixels, offsets: IntArray, fill: float, *, erosion: bool) -> Pixels:
    """Let OpenCV do the work; it lays kernels on as they are, in its dilation too."""
    # OpenCV wants its anchor inside the kernel: the box is widened to hold the origin
    first = np.minimum(offsets.min(axis=0), 0)
    last = np.maximum(offsets.max(axis=0), 0)
    kernel = np.zeros(last - first + 1, dtype=np.uint8)
    kernel[tuple((offsets - first).T)] = 1
    work = cv2.erode if erosion else cv2.dilate
    result = work(
        np.ascontiguousarray(image),
        kernel,
        anchor=(-int(first[1]), -int(first[0])),
        borderType=cv2.BORDER_CONSTANT,
        borderValue=float(fill),
    )
    return np.asarray(result).reshape(image.shape)


def _non_flat(
    image: Pixels, laid: StructuringElement, outside: Outside, *, erosion: bool
) -> Pixels:
    """Take the extreme of f(r + i, c + j) -/+ b pixel by pixel of the element."""
    assert laid.heights is not None  # noqa: S101  # for the type checker
    sign, extreme = (-1.0, np.minimum) if erosion else (1.0, np.maximum)
    neutral = outside == "neutral"
    result = np.full(image.shape, np.inf if erosion else -np.inf)
    values = image.astype(np.float64)
    for (i, j), height in zip(laid.offsets, laid.heights, strict=True):
        target, source = _overlap(image.shape[0], int(i)), _overlap(image.shape[1], int(j))
        inner = (target[0], source[0])
        if not neutral:  # what this pixel of the element finds outside is 0
            beyond = np.full(image.shape, sign * height)
            beyond[inner] = values[target[1], source[1]] + sign * height
            extreme(result, beyond, out=result)
            continue
        found = values[target[1], source[1]] + sign * height
        result[inner] = extreme(result[inner], found)
    return result


def _overlap(length: int, shift: int) -> tuple[slice, slice]:
    """Return where x and x + shift both lie within a length: slices of x and of x + shift."""
    low, high = max(0, -shift), max(0, min(length, length - shift))
    return slice(low, max(low, high)), slice(low + shift, max(low, high) + shift)
