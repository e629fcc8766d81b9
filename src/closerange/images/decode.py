"""Image files to frames: every bit kept, nothing turned, nothing guessed."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import CloseRangeWarning, ImageError, InputError
from closerange.files import read_limited
from closerange.images import tiff_header as tiff
from closerange.images.frame import Frame
from closerange.images.headers import ImageHeader, pixel_chunks, read_header

MAX_PIXELS = 200_000_000
"""Most pixels decoded (the largest area sensors on sale have 151 million). At 16 bits and
three colours this is 1.2 GB; a file of a few bytes can claim far more."""

MAX_IMAGE_BYTES = 2**30
"""Largest image file read (1 GiB: 200 million grey pixels of 16 bits are 0.4 GB)."""

SUFFIXES = {
    **dict.fromkeys((".png",), "png"),
    **dict.fromkeys((".jpg", ".jpeg", ".jpe", ".jfif"), "jpeg"),
    **dict.fromkeys((".tif", ".tiff"), "tiff"),
    **dict.fromkeys((".bmp", ".dib"), "bmp"),
}
"""File name endings, in lower case, and the formats that they promise."""

# as cv2.IMREAD_UNCHANGED alone, which has all bits set; written out because it is meant
_AS_STORED = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
_PIECEWISE = (5, 8, 32773, 32946)  # TIFF compressions without loss: LZW, Deflate, PackBits

_TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored and turned by 90 degrees",
    6: "turned by 90 degrees clockwise",
    7: "mirrored and turned by 270 degrees",
    8: "turned by 270 degrees clockwise",
}


def read_image(
    path: Path | str,
    *,
    camera: str = "",
    page: int | None = None,
    time_s: float | None = None,
    max_pixels: int = MAX_PIXELS,
) -> Frame:
    """Read an image file as grey values, as they were recorded.

    8 bits stay 8 and 16 stay 16; 1, 2 and 4 bits are spread over 0 to 255. Pixels are not
    turned, whatever the file says about orientation, because calibrations belong to the
    sensor. In TIFFs that store white as zero the values are inverted, so that large means
    bright. Colours become grey as Y = 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601).

    Parameters
    ----------
    path : Path or str
        A PNG, JPEG, TIFF or BMP file; its content decides, not its name.
    camera : str, optional
        Name of the camera.
    page : int, optional
        Which image of a TIFF with several, from 0.
    time_s : float, optional
        Moment of exposure in seconds.
    max_pixels : int, optional
        Limit on width times height, checked before anything is decoded.

    Returns
    -------
    Frame
        uint8 or uint16, shape (H, W).

    Raises
    ------
    FileError
        If the file is missing, empty, unreadable or above 1 GiB.
    ImageError
        If it is truncated, damaged, too large, of another format, has several pages and none
        was chosen, or holds pixels that are no whole grey values or colours.

    Warns
    -----
    CloseRangeWarning
        If the name promises another format, if colours were turned to grey, if transparency
        or an orientation was ignored.
    """
    path = Path(path)
    if page is not None and page < 0:
        raise InputError(f"page is {page}", remedy="pages are counted from 0")
    content = read_limited(path, _size_limit(path))
    header = read_header(content, str(path), page=page or 0)
    _check_header(header, page, max_pixels, str(path))
    pixels = _decode(content, header, page or 0, str(path))
    for note in _notes(path, header, pixels):
        warnings.warn(f"{path}: {note}", CloseRangeWarning, stacklevel=2)
    return Frame(camera, _grey(pixels, header), time_s, str(path))


def _size_limit(path: Path) -> int:
    """Return the file's size, or our limit; a reader reserves memory up to what it is given."""
    try:
        return min(path.stat().st_size, MAX_IMAGE_BYTES)
    except (OSError, ValueError):
        return MAX_IMAGE_BYTES  # the reader says what is wrong


def _check_header(header: ImageHeader, page: int | None, max_pixels: int, source: str) -> None:
    """Refuse too many pixels, and several pages without a choice."""
    count = header.width_px * header.height_px
    if count > max_pixels:
        raise ImageError(
            f"{source}: {header.width_px} x {header.height_px} = {count} pixels, "
            f"the limit is {max_pixels}",
            remedy="crop the image, or raise max_pixels if it is really that large",
        )
    if page is None and header.page_count > 1:
        raise ImageError(
            f"{source}: {header.page_count} images in one file",
            remedy="give the page, from 0, or save the images one by one",
        )
    if page and header.format != "tiff":
        raise ImageError(
            f"{source}: page {page} is asked for, a {header.format.upper()} has only page 0",
            remedy="leave the page out",
        )


def _decode(content: bytes, header: ImageHeader, page: int, source: str) -> NDArray[Any]:
    """Return the stored samples as OpenCV gives them, after checking that it altered nothing."""
    if header.format == "tiff":
        pixels = _decode_tiff(tiff.read_page(content, source, page), header)
    else:
        pixels = _imdecode(pixel_chunks(content) if header.format == "png" else content)
    if pixels is None:
        raise ImageError(
            f"{source}: the {header.format.upper()} pixels are damaged, or packed in a way "
            "that OpenCV does not know",
            remedy="copy the file again, or save it as PNG",
        )
    channels = 1 if pixels.ndim == 2 else pixels.shape[2]
    # grey with alpha and palettes are expanded; BMP may lose its unused fourth byte
    possible = {1: {1}, 2: {4}, 3: {3}, 4: {3, 4}}[header.channels]
    if header.palette:
        possible = {1, 3}
    dtype = np.uint16 if header.bit_depth == 16 else np.uint8
    size = (header.height_px, header.width_px)
    if pixels.dtype != dtype or pixels.shape[:2] != size or channels not in possible:
        raise ImageError(
            f"{source}: decoded as {pixels.dtype} of shape {pixels.shape}, the header says "
            f"{header.bit_depth} bits, {header.channels} channels of shape {size}",
            remedy="save it as a grey PNG of 8 or 16 bits",
        )
    return pixels


def _decode_tiff(page: tiff.TiffPage, header: ImageHeader) -> NDArray[Any] | None:
    """Decode one page, upright, with the stored values.

    OpenCV turns TIFFs by their orientation even when told not to, and inverts white-is-zero
    at 8 bits but not at 16. So the decoder is given a copy whose tags say neither.
    """
    changes = {tiff.PHOTOMETRIC: 1} if header.white_is_zero else {}
    if _has_checked_pieces(page, header):
        return _decode_tiff_in_pairs(page, header, changes)
    return _imdecode(tiff.single_page(page, changes))


def _has_checked_pieces(page: tiff.TiffPage, header: ImageHeader) -> bool:
    """Tell whether `_decode_tiff_in_pairs` can be used: the usual compressed grey image."""
    return (
        header.bit_depth == 8
        and header.width_px % 2 == 0
        and not header.palette
        and header.channels == 1
        and tiff.TILE_OFFSETS not in page.entries
        and page.number(tiff.COMPRESSION, 1) in _PIECEWISE
        and page.number(tiff.PREDICTOR, 1) in {1, 2}
    )


def _decode_tiff_in_pairs(
    page: tiff.TiffPage, header: ImageHeader, changes: dict[int, int]
) -> NDArray[Any] | None:
    """Decode 8-bit pixels as 16-bit pairs, because then OpenCV reports a damaged strip.

    On its way for 8 bits a strip that cannot be unpacked silently becomes black or partial.
    Unpacking knows only bytes; the differences of neighbours (predictor 2) are summed here.
    """
    differences = page.number(tiff.PREDICTOR, 1) == 2
    changes = changes | {
        tiff.WIDTH: header.width_px // 2,
        tiff.BITS: 16,
        tiff.PREDICTOR: 1,
    }
    pairs = _imdecode(tiff.single_page(page, changes))
    if pairs is None or pairs.dtype != np.uint16:
        return None
    pixels = np.ascontiguousarray(pairs).astype(page.order + "u2").view(np.uint8)
    return np.add.accumulate(pixels, axis=1, dtype=np.uint8) if differences else pixels


def _grey(pixels: NDArray[Any], header: ImageHeader) -> NDArray[Any]:
    """Return grey values in which large means bright."""
    if pixels.ndim == 3:
        code = cv2.COLOR_BGR2GRAY if pixels.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        pixels = cv2.cvtColor(pixels, code)
    if header.white_is_zero:
        pixels = np.bitwise_not(pixels)
    return pixels


def _notes(path: Path, header: ImageHeader, pixels: NDArray[Any]) -> Iterator[str]:
    """Yield what the user should know about how the file was read."""
    suffix = path.suffix.lower()
    # ".10001" is a number that particle-tracking programs append, not a promise
    if suffix and not suffix[1:].isdigit() and SUFFIXES.get(suffix) != header.format:
        yield f"is a {header.format.upper()} file by its content, not what {suffix!r} says"
    colour = pixels.ndim == 3 and header.channels != 2
    if colour or header.alpha:
        parts = ["colours turned to grey (0.299 R + 0.587 G + 0.114 B)"] if colour else []
        parts += ["transparency ignored"] if header.alpha else []
        yield "; ".join(parts) + "; a grey image of the sensor itself measures better"
    if header.orientation != 1:
        yield (
            f"its orientation tag {header.orientation} ({_TURNS[header.orientation]}) is not "
            "applied; x and y count from the first pixel stored"
        )


def _imdecode(content: bytes) -> NDArray[Any] | None:
    """Decode with OpenCV, quietly; None if it cannot."""
    with _quiet_opencv():
        try:
            pixels: NDArray[Any] | None = cv2.imdecode(np.frombuffer(content, np.uint8), _AS_STORED)
        except cv2.error:
            return None
    return pixels


_quiet_lock = threading.Lock()
_quiet_state = {"readers": 0, "level": 0}


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from printing about bad files; the level is put back by the last reader."""
    with _quiet_lock:
        if _quiet_state["readers"] == 0:
            _quiet_state["level"] = _set_log_level(0)
        _quiet_state["readers"] += 1
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_state["readers"] -= 1
            if _quiet_state["readers"] == 0:
                _set_log_level(_quiet_state["level"])


def _set_log_level(level: int) -> int:
    """Set OpenCV's log level and return the former one; the functions moved within 4.x."""
    place = getattr(cv2.utils, "logging", cv2)
    former = int(place.getLogLevel())
    place.setLogLevel(level)
    return former
