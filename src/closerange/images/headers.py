"""What an image file says about itself, decided by content and checked to be whole.

`cv2.imdecode` returns part of an image from part of a file without a word, turns some
16-bit files into 8 bits, and may reserve gigabytes for a file of fifty bytes. So the header
is read here first, and the file is walked to its end, before a pixel is decoded.

What this can not see: a PNG is protected by checksums, the other formats are not. Altered
bytes inside the pixels of a TIFF, BMP or JPEG stay unnoticed, and so does a JPEG whose scan
was cut and closed again with a proper end marker.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass

from closerange.errors import ImageError
from closerange.images import tiff_header as tiff
from closerange.images.tiff_header import MAX_SIDE

MAX_PIECES = 2**20
"""Most chunks or segments in a PNG or JPEG (a 1 GiB PNG of 8 KiB chunks has 131 072)."""

_PNG = b"\x89PNG\r\n\x1a\n"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_PNG_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # colour type: samples of a pixel
_PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PNG_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"IDAT", b"IEND")
_BMP_HEADERS = (40, 52, 56, 64, 108, 124)
_BMP_BGRA = bytes.fromhex("0000ff00 00ff0000 ff000000")  # masks of red, green and blue
_JPEG_FRAMES = (0xC0, 0xC1, 0xC2)  # baseline, extended, progressive; all Huffman-coded
_JPEG_OTHER_FRAMES = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
_AGAIN = "copy the file again, or take the image again"
_CONVERT = "save it as a grey PNG or TIFF of 8 or 16 bits"


@dataclass(frozen=True, slots=True, eq=False)
class ImageHeader:
    """An image file's description of its pixels.

    Attributes
    ----------
    format : str
        ``"png"``, ``"jpeg"``, ``"tiff"`` or ``"bmp"``.
    width_px, height_px : int
        Size as stored, before any rotation.
    bit_depth : int
        Bits of a sample: 1, 2, 4, 8 or 16.
    channels : int
        Samples of a pixel, alpha included: 1 to 4.
    page_count : int
        Images in the file.
    orientation : int
        EXIF or TIFF orientation, 1 (upright) to 8.
    white_is_zero : bool
        Whether small stored values mean white (TIFF).
    palette : bool
        Whether the sample is an index into a table of colours.
    alpha : bool
        Whether it has transparency.
    """

    format: str
    width_px: int
    height_px: int
    bit_depth: int
    channels: int = 1
    page_count: int = 1
    orientation: int = 1
    white_is_zero: bool = False
    palette: bool = False
    alpha: bool = False


def read_header(content: bytes, source: str, *, page: int = 0) -> ImageHeader:
    """Read an image file's header and check that the file is whole; decode nothing.

    Parameters
    ----------
    content : bytes
        The file. Its first bytes decide the format, not its name.
    source : str
        Its name for messages.
    page : int, optional
        Page of a TIFF, from 0.

    Returns
    -------
    ImageHeader
        The description of that page.

    Raises
    ------
    ImageError
        If the format is not PNG, JPEG, TIFF or BMP; if the file is truncated or damaged; if
        its pixels are of a kind that cannot become exact grey values.
    """
    if content[:8] == _PNG:
        header = _read_png(content, source)
    elif content[:3] == b"\xff\xd8\xff":
        header = _read_jpeg(content, source)
    elif content[:4] in _TIFF:
        header = _read_tiff(content, source, page)
    elif content[:2] == b"BM":
        header = _read_bmp(content, source)
    else:
        raise ImageError(
            f"{source}: not an image that can be read (begins with {content[:8]!r}); "
            "allowed are PNG, JPEG, TIFF and BMP",
            remedy="export the image as PNG or TIFF",
        )
    return header


def pixel_chunks(content: bytes) -> bytes:
    """Return a whole PNG file with only the chunks that its pixels need.

    Transparency, gamma, colour profiles, orientation and animation never reach the decoder.
    """
    kept = [_PNG]
    at = 8
    while at < len(content):
        end = at + 12 + int.from_bytes(content[at : at + 4], "big")
        if content[at + 4 : at + 8] in _PNG_PIXEL_CHUNKS:
            kept.append(content[at:end])
        if content[at + 4 : at + 8] == b"IEND":
            break
        at = end
    return b"".join(kept)


def _read_png(content: bytes, source: str) -> ImageHeader:
    """Walk the chunks of a PNG, with their checksums, to the end mark."""
    chunks: dict[bytes, bytes] = {}
    at = 8
    for _ in range(MAX_PIECES):
        kind, end = content[at + 4 : at + 8], at + 12 + int.from_bytes(content[at : at + 4], "big")
        if end > len(content):
            raise _truncated("PNG", source, f"{len(content)} bytes, chunk {kind!r} ends at {end}")
        body = memoryview(content)[at + 4 : end - 4]
        if zlib.crc32(body).to_bytes(4, "big") != content[end - 4 : end]:
            raise _damaged("PNG", source, f"the checksum of chunk {kind!r} at byte {at} is wrong")
        if kind in {b"IHDR", b"acTL", b"eXIf"}:
            chunks.setdefault(kind, bytes(body[4:]))
        else:
            chunks.setdefault(kind, b"")
        at = end
        if kind == b"IEND":
            break
    if next(iter(chunks)) != b"IHDR" or b"IEND" not in chunks or b"IDAT" not in chunks:
        raise _damaged("PNG", source, "begins without IHDR, has no pixels or no end")
    if len(chunks[b"IHDR"]) != 13:
        raise _damaged("PNG", source, f"IHDR has {len(chunks[b'IHDR'])} bytes instead of 13")
    width, height, depth, colour = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    if depth not in _PNG_DEPTHS.get(colour, ()):
        raise _damaged("PNG", source, f"has colour type {colour} with {depth} bits")
    _check_sides("PNG", source, width, height)
    animation = chunks.get(b"acTL", b"")
    return ImageHeader(
        *("png", width, height, depth, _PNG_SAMPLES[colour]),
        page_count=max(1, int.from_bytes(animation[:4], "big")),
        orientation=tiff.exif_orientation(chunks.get(b"eXIf", b"")),
        palette=colour == 3,
        alpha=colour in {4, 6} or b"tRNS" in chunks,
    )


def _read_jpeg(content: bytes, source: str) -> ImageHeader:
    """Walk the segments and scans of a JPEG to the end mark."""
    frame, orientation, scans = b"", 1, 0
    at = 2
    for _ in range(MAX_PIECES):
        marker, start, end = _jpeg_segment(content, at, source)
        if marker == 0xD9:
            break
        if marker in _JPEG_OTHER_FRAMES:
            raise _unusable("JPEG", source, f"coding process {marker - 0xC0} (not Huffman DCT)")
        if marker in _JPEG_FRAMES:
            if frame:
                raise _damaged("JPEG", source, "has two frame headers")
            frame = content[start:end]
        elif marker == 0xE1 and content[start : start + 6] == b"Exif\0\0":
            orientation = tiff.exif_orientation(content[start + 6 : end])
        scans += marker == 0xDA
        at = end
    else:
        raise _damaged("JPEG", source, f"has more than {MAX_PIECES} segments")
    if len(frame) < 6 or not scans:
        raise _damaged("JPEG", source, "has no frame header or no scan")
    depth, height, width, channels = struct.unpack(">BHHB", frame[:6])
    if depth != 8 or channels not in {1, 3}:
        raise _unusable("JPEG", source, f"{channels} channels of {depth} bits; 1 or 3 of 8 allowed")
    _check_sides("JPEG", source, width, height)
    return ImageHeader("jpeg", width, height, 8, channels, orientation=orientation)


def _jpeg_segment(content: bytes, at: int, source: str) -> tuple[int, int, int]:
    """Return a segment's marker and where its body starts and ends; a scan ends with its data."""
    first = at
    while content[at : at + 1] == b"\xff" and content[at + 1 : at + 2] == b"\xff":
        at += 1  # fill bytes
    if at + 2 > len(content):
        raise _truncated("JPEG", source, f"{len(content)} bytes, without an end mark")
    if content[at] != 0xFF or content[at + 1] == 0:
        raise _damaged("JPEG", source, f"has no marker at byte {first}")
    marker = content[at + 1]
    if marker == 0x01 or 0xD0 <= marker <= 0xD9:
        return marker, at + 2, at + 2
    end = at + 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    if end > len(content):
        raise _truncated("JPEG", source, f"{len(content)} bytes, a segment ends at {end}")
    if end < at + 4:
        raise _damaged("JPEG", source, f"has a segment of {end - at - 2} bytes at byte {at}")
    if marker == 0xDA:
        found = _MARKER_IN_SCAN.search(content, end)
        if found is None:
            raise _truncated("JPEG", source, f"{len(content)} bytes, without an end mark")
        end = found.start()
    return marker, at + 4, end


def _read_tiff(content: bytes, source: str, number: int) -> ImageHeader:
    """Read one page's tags and check that its strips or tiles lie inside the file."""
    page = tiff.read_page(content, source, number)
    width, height = page.number(tiff.WIDTH, 0), page.number(tiff.HEIGHT, 0)
    _check_sides("TIFF", source, width, height)
    depth, samples = page.number(tiff.BITS, 1), page.number(tiff.SAMPLES, 1)
    photometric = page.number(tiff.PHOTOMETRIC, 1)
    _check_tiff_kind(page, depth, samples, photometric, source)
    tiff.check_extent(page, width, height, depth * samples)
    return ImageHeader(
        *("tiff", width, height, depth, samples),
        page_count=page.page_count,
        orientation=tiff.orientation(page),
        white_is_zero=photometric == 0,
        palette=photometric == 3,
    )


def _check_tiff_kind(
    page: tiff.TiffPage, depth: int, samples: int, photometric: int, source: str
) -> None:
    """Refuse pixels that OpenCV alters, or that are no grey values or colours."""
    if (kind := page.number(tiff.SAMPLE_FORMAT, 1)) != 1:
        words = {2: "signed", 3: "floating-point"}.get(kind, f"format {kind}")
        raise _unusable("TIFF", source, f"{words} pixels of {depth} bits")
    # grey or palette have one sample, RGB and YCbCr three. OpenCV turns grey with alpha from
    # 16 bits into 8 and multiplies colours by alpha
    allowed = {0: 1, 1: 1, 2: 3, 3: 1, 6: 3}
    if allowed.get(photometric) != samples:
        raise _unusable(
            "TIFF", source, f"{samples} samples with photometric interpretation {photometric}"
        )
    # OpenCV has no grey 2 or 4 bits, and shifts 10, 12 and 14 bits up to 16
    depths = {0: (1, 8, 16), 1: (1, 8, 16), 2: (8, 16), 3: (4, 8), 6: (8,)}[photometric]
    if depth not in depths:
        allowed_text = ", ".join(map(str, depths))
        raise _unusable("TIFF", source, f"samples of {depth} bits; allowed are {allowed_text}")
    if samples > 1 and page.number(tiff.PLANAR, 1) != 1:
        raise _unusable("TIFF", source, "colours in separate planes")
    if photometric == 6 and page.number(tiff.COMPRESSION, 1) != 7:
        raise _unusable("TIFF", source, "YCbCr colours that are not JPEG-compressed")
    if page.number(tiff.FILL_ORDER, 1) != 1:
        raise _unusable("TIFF", source, "bits in reverse order")


def _read_bmp(content: bytes, source: str) -> ImageHeader:
    """Read the fixed header of a BMP and check its size."""
    if len(content) < 54:
        raise _truncated("BMP", source, f"{len(content)} bytes, its header needs 54")
    offset, size, width, height, _, bits, packing = struct.unpack_from("<IIiiHHI", content, 10)
    if size not in _BMP_HEADERS:
        raise _unusable("BMP", source, f"a header of {size} bytes")
    masks = packing in {3, 6} and bits == 32 and content[54:66] == _BMP_BGRA
    if bits not in {1, 4, 8, 24, 32} or not (packing == 0 or masks):
        raise _unusable("BMP", source, f"{bits} bits a pixel with compression {packing}")
    height = abs(height)  # negative: stored from the top down
    _check_sides("BMP", source, width, height)
    if offset < 14 + size:
        raise _damaged("BMP", source, f"has pixels at byte {offset}, inside its header")
    end = offset + height * ((width * bits + 31) // 32 * 4)
    if end > len(content):
        raise _truncated("BMP", source, f"{len(content)} bytes, its pixels end at {end}")
    channels = {24: 3, 32: 4}.get(bits, 1)
    return ImageHeader(
        *("bmp", width, height, min(bits, 8), channels), palette=bits <= 8, alpha=bits == 32
    )


def _check_sides(kind: str, source: str, width_px: int, height_px: int) -> None:
    """Refuse impossible sizes before anything is computed from them."""
    if not (1 <= width_px <= MAX_SIDE and 1 <= height_px <= MAX_SIDE):
        raise _damaged(
            kind, source, f"says {width_px} x {height_px} pixels; sides are 1 to {MAX_SIDE}"
        )


def _truncated(kind: str, source: str, what: str) -> ImageError:
    """Say that the file ends too early."""
    return ImageError(f"{source}: {kind} truncated: {what}", remedy=_AGAIN)


def _damaged(kind: str, source: str, what: str) -> ImageError:
    """Say that the file contradicts its format."""
    return ImageError(f"{source}: {kind} {what}", remedy=_AGAIN)


def _unusable(kind: str, source: str, what: str) -> ImageError:
    """Say that these pixels would not keep their meaning."""
    return ImageError(f"{source}: {kind} with {what} cannot be used", remedy=_CONVERT)
