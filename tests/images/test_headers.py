"""Headers: what a file says, and whether it is all there."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest

from closerange.errors import ImageError
from closerange.images import read_header

PIXELS = np.random.default_rng(1).integers(0, 256, (24, 32), dtype=np.uint8)
WHOLE = {ext: cv2.imencode(ext, PIXELS)[1].tobytes() for ext in (".png", ".jpg", ".tif", ".bmp")}


def chunk(kind: bytes, body: bytes) -> bytes:
    checksum = struct.pack(">I", zlib.crc32(kind + body))
    return struct.pack(">I", len(body)) + kind + body + checksum


def png(width: int, height: int, depth: int, colour: int, *, extra: bytes = b"") -> bytes:
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(b""))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + extra + data + chunk(b"IEND", b"")


def tiff(tags: dict[int, int], *, order: str = "<", following: int = 0, tail: int = 0) -> bytes:
    """A TIFF of one directory of LONG tags at byte 8, and `tail` bytes of pixels behind it."""
    mark = b"II" if order == "<" else b"MM"
    entries = [struct.pack(order + "HHII", tag, 4, 1, value) for tag, value in sorted(tags.items())]
    directory = struct.pack(order + "H", len(tags)) + b"".join(entries)
    directory += struct.pack(order + "I", following)
    return mark + struct.pack(order + "HI", 42, 8) + directory + bytes(tail)


def grey_tags(width: int, height: int, **others: int) -> dict[int, int]:
    tags = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 277: 1, 278: height}
    tags |= {273: 8, 279: min(width * height, 2**32 - 1)}
    return tags | {int(tag[1:]): value for tag, value in others.items()}


@pytest.mark.parametrize(
    ("ext", "name"), [(".png", "png"), (".jpg", "jpeg"), (".tif", "tiff"), (".bmp", "bmp")]
)
def test_header_agrees_with_what_was_written(ext, name):
    header = read_header(WHOLE[ext], "x")
    found = (header.format, header.width_px, header.height_px, header.bit_depth, header.channels)
    assert found == (name, 32, 24, 8, 1)
    assert (header.page_count, header.orientation, header.white_is_zero) == (1, 1, False)


@pytest.mark.parametrize("ext", WHOLE)
def test_every_truncation_is_refused(ext):
    content = WHOLE[ext]
    # behind its end mark a file may have anything; up to it every byte counts
    lengths = [*range(3, len(content), 37), len(content) - 2, len(content) - 1]
    for length in lengths:
        with pytest.raises(ImageError) as error:
            read_header(content[:length], "cut.img")
        assert "cut.img" in error.value.message
        assert error.value.remedy


@pytest.mark.parametrize("ext", [".png", ".jpg", ".bmp"])
def test_a_half_file_is_called_truncated(ext):
    with pytest.raises(ImageError, match="truncated"):
        read_header(WHOLE[ext][: len(WHOLE[ext]) // 2], "x")


def test_a_tiff_whose_strip_ends_beyond_the_file_is_called_truncated():
    content = tiff(grey_tags(32, 24), tail=700)
    with pytest.raises(ImageError, match=r"truncated: \d+ bytes, its tags point to byte 776"):
        read_header(content[:600], "x")
    assert read_header(content, "x").width_px == 32


def test_a_flipped_bit_in_a_png_is_found_by_its_checksum():
    for at in range(8, len(WHOLE[".png"]), 41):
        damaged = bytearray(WHOLE[".png"])
        damaged[at] ^= 0x10
        with pytest.raises(ImageError, match="PNG"):
            read_header(bytes(damaged), "x")


def test_bytes_behind_the_end_mark_do_no_harm():
    for ext in (".png", ".jpg"):
        assert read_header(WHOLE[ext] + b"more", "x").height_px == 24


@pytest.mark.parametrize(
    "content",
    [
        png(2_000_000_000, 2_000_000_000, 8, 0),
        png(0, 5, 8, 0),
        tiff(grey_tags(2**32 - 1, 2**32 - 1)),
        tiff(grey_tags(0, 4)),
        tiff(grey_tags(100_000, 100_000, t278=1), tail=64),
        tiff({256: 16, 257: 16, 258: 8, 259: 1, 322: 2**31, 323: 2**31, 324: 8, 325: 256}),
        b"BM" + struct.pack("<IIIIiiHHIIIIII", 0, 0, 54, 40, -5, 5, 1, 8, *[0] * 6),
        b"BM" + struct.pack("<IIIIiiHHIIIIII", 0, 0, 54, 40, 10**6, -(2**31), 1, 8, *[0] * 6),
        b"BM" + struct.pack("<IIIIiiHHIIIIII", 0, 0, 54, 40, 10**6, 10**6, 1, 8, *[0] * 6),
    ],
)
def test_absurd_sizes_are_refused_without_memory(content):
    tracemalloc.start()
    with pytest.raises(ImageError):
        read_header(content, "x")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20, f"{peak} bytes for a file of {len(content)}"


def test_a_chain_of_pages_that_returns_is_refused():
    with pytest.raises(ImageError, match="returns to byte 8"):
        read_header(tiff(grey_tags(4, 4), following=8), "x")


def test_counts_and_offsets_beyond_the_file_are_refused():
    for broken in (
        tiff(grey_tags(4, 4), following=10**9),
        b"II*\0" + struct.pack("<IH", 8, 0xFFFF),
        b"II*\0" + struct.pack("<I", 2**32 - 1),
        b"II+\0" + struct.pack("<HHQQ", 8, 0, 16, 2**64 - 1),
        tiff(grey_tags(4, 4)).replace(
            struct.pack("<HHI", 273, 4, 1), struct.pack("<HHI", 273, 4, 2**32 - 1)
        ),
    ):
        with pytest.raises(ImageError, match="TIFF"):
            read_header(broken, "x")


@pytest.mark.parametrize(
    ("tags", "words"),
    [
        ({"t339": 3, "t258": 32}, "floating-point pixels of 32 bits"),
        ({"t339": 2}, "signed pixels"),
        ({"t258": 12}, "samples of 12 bits"),
        ({"t258": 4}, "samples of 4 bits"),
        ({"t277": 2}, "2 samples"),
        ({"t262": 5, "t277": 4}, "photometric interpretation 5"),
        ({"t262": 32803}, "photometric interpretation 32803"),
        ({"t262": 2, "t277": 3, "t284": 2}, "separate planes"),
        ({"t266": 2}, "reverse order"),
    ],
)
def test_tiff_pixels_that_would_lose_their_meaning_are_refused(tags, words):
    with pytest.raises(ImageError, match=words):
        read_header(tiff(grey_tags(8, 8, **tags), tail=4096), "x")


def test_big_tiff_is_read():
    tags = grey_tags(32, 24)
    tags[273] = 300
    entries = [struct.pack(">HHQQ", tag, 16, 1, value) for tag, value in sorted(tags.items())]
    content = b"MM\0+" + struct.pack(">HHQQ", 8, 0, 16, len(tags)) + b"".join(entries) + bytes(8)
    content += bytes(300 - len(content)) + bytes(32 * 24)
    header = read_header(content, "x")
    assert (header.width_px, header.height_px, header.page_count) == (32, 24, 1)


def test_orientation_is_read_from_all_three_places():
    exif = tiff({274: 6}, order=">")
    jpg = WHOLE[".jpg"]
    body = b"Exif\0\0" + exif
    marked = jpg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpg[2:]
    assert read_header(marked, "x").orientation == 6
    assert read_header(png(4, 4, 8, 0, extra=chunk(b"eXIf", exif)), "x").orientation == 6
    assert read_header(tiff(grey_tags(4, 4, t274=3), tail=64), "x").orientation == 3
    # a damaged note about the pixels is no reason to refuse them
    assert read_header(png(4, 4, 8, 0, extra=chunk(b"eXIf", exif[:9])), "x").orientation == 1
    assert read_header(tiff(grey_tags(4, 4, t274=99), tail=64), "x").orientation == 1


def test_other_formats_are_refused_by_name_of_the_allowed_ones():
    for content in (b"GIF89a" + bytes(50), b"RIFF\0\0\0\0WEBP", b"\x93NUMPY", b"P5 4 4 255 ", b"x"):
        with pytest.raises(ImageError, match="allowed are PNG, JPEG, TIFF and BMP"):
            read_header(content, "x")


def test_jpeg_kinds_that_are_not_huffman_grey_or_colour_are_refused():
    at = WHOLE[".jpg"].index(b"\xff\xc0")
    lossless, deep, cmyk = (bytearray(WHOLE[".jpg"]) for _ in range(3))
    lossless[at + 1] = 0xC3
    deep[at + 4] = 12
    cmyk[at + 9] = 4
    for content in (lossless, deep, cmyk):
        with pytest.raises(ImageError, match="JPEG with"):
            read_header(bytes(content), "x")


def test_a_progressive_jpeg_with_many_scans_is_whole():
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_RST_INTERVAL, 1]
    content = cv2.imencode(".jpg", PIXELS, options)[1].tobytes()
    assert content.count(b"\xff\xda") > 1
    assert read_header(content, "x").width_px == 32
    with pytest.raises(ImageError, match="truncated"):
        read_header(content[:-30], "x")


def test_chunk_and_segment_floods_end():
    flood = b"\xff\xd8" + b"\xff\xfe\0\2" * 1000
    with pytest.raises(ImageError, match="truncated"):
        read_header(flood, "x")
    animated = png(4, 4, 8, 0, extra=chunk(b"acTL", struct.pack(">II", 7, 0)))
    assert read_header(animated, "x").page_count == 7
