"""The structure of a TIFF file: pages, tags, where the pixels lie; no pixel is decoded.

TIFF 6.0 (Adobe, 1992) and BigTIFF. EXIF uses the same structure, so its orientation is read
here too. Offsets and counts come from the file and are believed only after a check: nothing
is read outside of it, and no loop is longer than the file allows.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.errors import ImageError

MAX_PAGES = 10_000
"""Most pages in one file (a stack of ten thousand images; more is a broken chain)."""

MAX_TAGS = 4096
"""Most tags on a page; real files have fewer than a hundred."""

MAX_SIDE = 2**20
"""Longest side of an image or tile in pixels; also OpenCV's own limit."""

WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, FILL_ORDER = 256, 257, 258, 259, 262, 266
STRIP_OFFSETS, ORIENTATION, SAMPLES, ROWS_PER_STRIP, STRIP_BYTES = 273, 274, 277, 278, 279
PLANAR, PREDICTOR, COLOR_MAP = 284, 317, 320
TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS, TILE_BYTES = 322, 323, 324, 325
SAMPLE_FORMAT, JPEG_TABLES = 339, 347
_YCBCR = (529, 530, 531, 532)

_PIXEL_TAGS = {
    *(WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, STRIP_OFFSETS, SAMPLES, ROWS_PER_STRIP),
    *(STRIP_BYTES, PLANAR, PREDICTOR, COLOR_MAP, TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS),
    *(TILE_BYTES, SAMPLE_FORMAT, JPEG_TABLES, *_YCBCR),
}
_ITEM_TYPE = {1: "u1", 3: "u2", 4: "u4", 13: "u4", 16: "u8"}  # TIFF type: NumPy type
_ITEM_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4}
_ITEM_BYTES |= {16: 8, 17: 8, 18: 8}
REMEDY = "copy the file again, or export the image as PNG or as a plain TIFF"


@dataclass(frozen=True, slots=True, eq=False)
class TiffPage:
    """One page's tags, with the file that they point into.

    Attributes
    ----------
    content : bytes
        The whole file.
    source : str
        Its name for messages.
    order : str
        ``"<"`` or ``">"``, the byte order.
    big : bool
        Whether it is BigTIFF, with 8-byte offsets.
    entries : dict of int to (int, int, bytes)
        Tag: item type, count and the value field as it stands in the file.
    page_count : int
        Pages in the whole file.
    """

    content: bytes
    source: str
    order: str
    big: bool
    entries: dict[int, tuple[int, int, bytes]]
    page_count: int

    def values(self, tag: int) -> NDArray[np.int64]:
        """Return all numbers of a tag, empty if the page does not have it."""
        if tag not in self.entries:
            return np.empty(0, np.int64)
        kind, count, field = self.entries[tag]
        if kind not in _ITEM_TYPE:
            raise _broken(self.source, f"tag {tag} has the type {kind}, not a whole number")
        size = count * _ITEM_BYTES[kind]
        if size > len(field):
            start = _number(field, self.order)
            if start + size > len(self.content):
                raise _truncated(self.source, start + size, len(self.content))
            field = self.content[start : start + size]
        numbers = np.frombuffer(field[:size], self.order + _ITEM_TYPE[kind])
        if kind == 16 and numbers.size and int(numbers.max()) >= 2**62:
            raise _broken(self.source, f"tag {tag} holds {numbers.max()}")
        return numbers.astype(np.int64)

    def number(self, tag: int, default: int) -> int:
        """Return the only number of a tag, or of several equal ones (one for each sample)."""
        numbers = self.values(tag)
        if numbers.size == 0:
            return default
        if (numbers != numbers[0]).any():
            raise _broken(self.source, f"tag {tag} differs from sample to sample")
        return int(numbers[0])


def read_page(content: bytes, source: str, page: int = 0) -> TiffPage:
    """Read the tags of one page and follow the chain of the others.

    Parameters
    ----------
    content : bytes
        The file.
    source : str
        Its name for messages.
    page : int, optional
        From 0.

    Returns
    -------
    TiffPage
        Its tags.

    Raises
    ------
    ImageError
        If the chain of pages leaves the file, runs in a circle or ends before `page`.
    """
    order = "<" if content[:2] == b"II" else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    offset = _number(_span(content, 8 if big else 4, 8 if big else 4, source), order)
    offsets: dict[int, None] = {}  # an ordered set
    while offset:
        if offset in offsets:
            raise _broken(source, f"the chain of pages returns to byte {offset}")
        if len(offsets) == MAX_PAGES:
            raise _broken(source, f"more than {MAX_PAGES} pages")
        offsets[offset] = None
        offset = _directory(content, offset, order, source, big=big)[1]
    if page >= len(offsets):
        raise ImageError(
            f"{source}: page {page} is asked for, the file has {len(offsets)} pages, from 0",
            remedy="give the number of a page that exists" if offsets else REMEDY,
        )
    body, _ = _directory(content, list(offsets)[page], order, source, big=big)
    return TiffPage(content, source, order, big, _entries(body, order, big=big), len(offsets))


def exif_orientation(exif: bytes) -> int:
    """Return the orientation in an EXIF block, from 1 to 8.

    Parameters
    ----------
    exif : bytes
        The block, beginning with ``II`` or ``MM``.

    Returns
    -------
    int
        1, upright, if the block has none or is damaged: it is only a note about the pixels.
    """
    if exif[:4] not in (b"II*\0", b"MM\0*"):
        return 1
    order = "<" if exif[:2] == b"II" else ">"
    try:
        offset = _number(_span(exif, 4, 4, "EXIF"), order)
        body, _ = _directory(exif, offset, order, "EXIF", big=False)
    except ImageError:
        return 1
    entries = _entries(body, order, big=False)
    return orientation(TiffPage(exif, "EXIF", order, big=False, entries=entries, page_count=1))


def orientation(page: TiffPage) -> int:
    """Return a page's orientation, 1 if it has none that means something."""
    try:
        value = page.number(ORIENTATION, 1)
    except ImageError:
        return 1
    return value if 1 <= value <= 8 else 1


def check_extent(page: TiffPage, width_px: int, height_px: int, bits_per_pixel: int) -> None:
    """Check that every strip or tile is there, whole, inside the file.

    Parameters
    ----------
    page : TiffPage
        The page.
    width_px, height_px : int
        Its size.
    bits_per_pixel : int
        Bits of a pixel over all samples, for uncompressed pages.

    Raises
    ------
    ImageError
        If pieces are missing, too few, too short or beyond the end of the file.
    """
    tiled = TILE_OFFSETS in page.entries
    offsets = page.values(TILE_OFFSETS if tiled else STRIP_OFFSETS)
    sizes = page.values(TILE_BYTES if tiled else STRIP_BYTES)
    across, rows = width_px, min(page.number(ROWS_PER_STRIP, height_px), height_px)
    if tiled:
        across, rows = page.number(TILE_WIDTH, 0), page.number(TILE_HEIGHT, 0)
    if not (1 <= across <= MAX_SIDE and 1 <= rows <= MAX_SIDE):
        raise _broken(page.source, f"tiles or strips of {across} x {rows} pixels")
    expected = -(-width_px // across) * -(-height_px // rows)
    if not offsets.size == sizes.size == expected:
        raise _broken(
            page.source,
            f"truncated: {offsets.size} strips or tiles with {sizes.size} sizes, "
            f"{width_px} x {height_px} pixels need {expected}",
        )
    end = int((offsets + sizes).max())
    if end > len(page.content):
        raise _truncated(page.source, end, len(page.content))
    heights = np.full(expected, rows)
    if not tiled:
        heights[-1] = height_px - rows * (expected - 1)
    plain = page.number(COMPRESSION, 1) == 1
    needed = heights * ((across * bits_per_pixel + 7) // 8) if plain else np.ones(expected)
    if (sizes < needed).any():
        worst = int(np.argmax(needed - sizes))
        raise _broken(
            page.source,
            f"truncated: strip or tile {worst} has {sizes[worst]} bytes of {int(needed[worst])}",
        )


def single_page(page: TiffPage, changes: dict[int, int]) -> bytes:
    """Return the file with one page whose tags say only what decoding the pixels needs.

    A new directory is appended and the header points to it, so all offsets stay valid.
    Orientation, colour profiles and other pages never reach the decoder.

    Parameters
    ----------
    page : TiffPage
        The page.
    changes : dict of int to int
        Tags that shall hold another single number.

    Returns
    -------
    bytes
        A TIFF file.
    """
    number, count = ("Q", "Q") if page.big else ("I", "H")
    width = struct.calcsize(page.order + number)
    entries = {tag: entry for tag, entry in page.entries.items() if tag in _PIXEL_TAGS}
    for tag, value in changes.items():
        code = "I" + "x" * (width - 4)
        entries[tag] = (4, 1, struct.pack(page.order + code, value))
    start = -(-len(page.content) // 8) * 8  # a directory begins on a word boundary
    directory = struct.pack(page.order + count, len(entries))
    for tag, (kind, items, field) in sorted(entries.items()):
        directory += struct.pack(page.order + "HH" + number, tag, kind, items) + field
    directory += bytes(width)
    padding = bytes(start - len(page.content))
    content = bytearray(page.content + padding + directory)
    struct.pack_into(page.order + number, content, 8 if page.big else 4, start)
    return bytes(content)


def _directory(
    content: bytes, offset: int, order: str, source: str, *, big: bool
) -> tuple[memoryview, int]:
    """Return where a directory's entries stand, uncopied, and the offset of the next one."""
    count_bytes, entry_bytes, number_bytes = (8, 20, 8) if big else (2, 12, 4)
    count = _number(_span(content, offset, count_bytes, source), order)
    if count > MAX_TAGS:
        raise _broken(source, f"has {count} tags on a page, the limit is {MAX_TAGS}")
    start = offset + count_bytes
    end = start + count * entry_bytes
    following = _number(_span(content, end, number_bytes, source), order)
    return memoryview(content)[start:end], following


def _entries(body: memoryview, order: str, *, big: bool) -> dict[int, tuple[int, int, bytes]]:
    """Return a directory's entries; of a doubled tag the first counts, as in libtiff."""
    head = struct.Struct(order + ("HHQ" if big else "HHI"))
    entries: dict[int, tuple[int, int, bytes]] = {}
    step = 20 if big else 12
    for start in range(0, len(body), step):
        tag, kind, items = head.unpack_from(body, start)
        entries.setdefault(tag, (kind, items, bytes(body[start + head.size : start + step])))
    return entries


def _span(content: bytes, start: int, size: int, source: str) -> bytes:
    """Return bytes of the file, all of them."""
    if start + size > len(content):
        raise _truncated(source, start + size, len(content))
    return content[start : start + size]


def _number(field: bytes, order: str) -> int:
    """Read an unsigned number that fills a field."""
    return int.from_bytes(field, "little" if order == "<" else "big")


def _truncated(source: str, needed: int, present: int) -> ImageError:
    """Say that the file ends too early."""
    return _broken(source, f"truncated: {present} bytes, its tags point to byte {needed}")


def _broken(source: str, what: str) -> ImageError:
    """Say that the structure is damaged."""
    return ImageError(f"{source}: TIFF {what}", remedy=REMEDY)
