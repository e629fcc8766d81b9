"""Decoding: every bit survives, and what cannot be trusted is refused."""

from __future__ import annotations

import struct
import threading
import tracemalloc
import warnings
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from closerange.errors import CloseRangeError, CloseRangeWarning, FileError, ImageError, InputError
from closerange.images import Frame, read_image
from closerange.images.decode import _quiet_opencv

RNG = np.random.default_rng(7)
GREY8 = RNG.integers(0, 256, (25, 34), dtype=np.uint8)
GREY16 = RNG.integers(0, 65536, (25, 34), dtype=np.uint16)
COLOUR = RNG.integers(0, 256, (25, 34, 3), dtype=np.uint8)
SMOOTH = (np.add.outer(np.arange(120) * 2, np.arange(90) * 3) % 256).astype(np.uint8)


def tiff_page(pixels, at, *, order="<", strips=1, predictor=1, compress=False, **tags):
    """Bytes of one page that begins at byte `at` of a file, and the place of its next-page field.

    Written by hand, so that it is independent of the library that reads it.
    """
    rows = -(-pixels.shape[0] // strips)
    stored = pixels.astype(pixels.dtype.newbyteorder(order))
    if predictor == 2:
        stored = stored.copy()
        stored[:, 1:] = np.diff(pixels.astype(np.int64), axis=1).astype(pixels.dtype)
    parts = [stored[start : start + rows].tobytes() for start in range(0, pixels.shape[0], rows)]
    parts = [zlib.compress(part) for part in parts] if compress else parts
    offsets = list(np.cumsum([at, *map(len, parts)])[:-1])
    body = b"".join(parts)
    lists = at + len(body)
    body += struct.pack(f"{order}{2 * len(parts)}I", *offsets, *map(len, parts))
    one = len(parts) == 1
    entries = {256: pixels.shape[1], 257: pixels.shape[0], 258: 8 * pixels.itemsize}
    entries |= {259: 8 if compress else 1, 262: 1, 277: 1, 278: rows, 317: predictor, 339: 1}
    entries |= {273: offsets[0] if one else lists, 279: len(parts[0]) if one else lists}
    if not one:
        entries[279] += 4 * len(parts)
    entries |= {int(tag[1:]): value for tag, value in tags.items()}
    directory = at + len(body)
    body += struct.pack(order + "H", len(entries))
    for tag, value in sorted(entries.items()):
        count = len(parts) if tag in {273, 279} else 1
        body += struct.pack(order + "HHII", tag, 4, count, value)
    return body + bytes(4), directory


def tiff(*pages, order="<", **options):
    """A TIFF of several pages."""
    content = bytearray((b"II" if order == "<" else b"MM") + struct.pack(order + "HI", 42, 0))
    link = 4
    for pixels in pages:
        body, directory = tiff_page(pixels, len(content), order=order, **options)
        struct.pack_into(order + "I", content, link, directory)
        content += body
        link = len(content) - 4
    return bytes(content)


@pytest.fixture
def put(tmp_path):
    def write(name, content):
        path = tmp_path / name
        path.write_bytes(content)
        return path

    return write


def encoded(ext, pixels, *options):
    return cv2.imencode(ext, pixels, list(options))[1].tobytes()


@pytest.mark.parametrize(
    ("ext", "pixels"),
    [(".png", GREY8), (".tif", GREY8), (".bmp", GREY8), (".png", GREY16), (".tif", GREY16)],
)
def test_round_trip_is_exact(put, ext, pixels):
    frame = read_image(put("a" + ext, encoded(ext, pixels)), camera="left", time_s=0.5)
    assert frame.pixels.dtype == pixels.dtype
    assert np.array_equal(frame.pixels, pixels)
    assert (frame.camera, frame.time_s, frame.size_px) == ("left", 0.5, (34, 25))
    assert frame.source.endswith("a" + ext)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("white_is_zero", [False, True])
@pytest.mark.parametrize(("compress", "predictor"), [(False, 1), (True, 1), (True, 2)])
@pytest.mark.parametrize("pixels", [GREY8, GREY16, GREY8[:, :33]], ids=["8", "16", "odd"])
def test_hand_made_tiff_is_exact(put, order, white_is_zero, compress, predictor, pixels):
    options = {"order": order, "strips": 4, "compress": compress, "predictor": predictor}
    content = tiff(pixels, **options, t262=0 if white_is_zero else 1)
    expected = np.iinfo(pixels.dtype).max - pixels if white_is_zero else pixels
    assert np.array_equal(read_image(put("a.tif", content)).pixels, expected)


@pytest.mark.parametrize("orientation", range(2, 9))
@pytest.mark.parametrize("pixels", [GREY8, GREY16], ids=["8", "16"])
def test_tiff_orientation_is_not_applied(put, orientation, pixels):
    path = put("a.tif", tiff(pixels, t274=orientation))
    with pytest.warns(CloseRangeWarning, match=f"orientation tag {orientation} .* not applied"):
        frame = read_image(path)
    assert np.array_equal(frame.pixels, pixels)


def exif(orientation):
    return b"MM\0*\0\0\0\x08\0\1" + struct.pack(">HHIHHI", 274, 3, 1, orientation, 0, 0)


def test_exif_orientation_of_jpeg_and_png_is_not_applied(put):
    jpg, png = encoded(".jpg", SMOOTH), encoded(".png", SMOOTH)
    body = b"Exif\0\0" + exif(6)
    turned_jpg = jpg[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + jpg[2:]
    chunk = b"eXIf" + exif(6)
    chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    turned_png = png[:33] + chunk + png[33:]
    for name, plain, turned in (("a.jpg", jpg, turned_jpg), ("a.png", png, turned_png)):
        expected = read_image(put(name, plain)).pixels
        with pytest.warns(CloseRangeWarning, match="turned by 90 degrees clockwise"):
            frame = read_image(put("t" + name, turned))
        assert frame.pixels.shape == SMOOTH.shape
        assert np.array_equal(frame.pixels, expected)


@pytest.mark.parametrize(
    ("ext", "dtype"),
    [(".png", np.uint8), (".tif", np.uint8), (".bmp", np.uint8), (".png", "u2"), (".tif", "u2")],
)
def test_colour_becomes_grey_by_the_documented_weights_with_one_warning(put, ext, dtype):
    colour = COLOUR.astype(dtype) * (np.iinfo(dtype).max // 255)
    with pytest.warns(CloseRangeWarning, match=r"0\.299 R") as caught:
        frame = read_image(put("a" + ext, encoded(ext, colour)))
    assert len(caught) == 1
    expected = colour.astype(float) @ [0.114, 0.587, 0.299]  # B, G, R
    # half a level of rounding, and OpenCV's integer weights: measured 0.498 and 1.40 levels
    assert np.abs(frame.pixels - expected).max() < 0.5 + 2e-5 * np.iinfo(dtype).max
    assert frame.pixels.dtype == dtype


def test_transparency_is_ignored_with_a_warning(put):
    opaque = cv2.cvtColor(GREY8, cv2.COLOR_GRAY2BGRA)
    opaque[..., 3] = RNG.integers(0, 256, GREY8.shape)
    for ext in (".png", ".bmp"):
        with pytest.warns(CloseRangeWarning) as caught:
            frame = read_image(put("a" + ext, encoded(ext, opaque)))
        assert len(caught) == 1
        assert np.array_equal(frame.pixels, GREY8)  # equal colours: their weights add up to 1


def test_transparent_tiff_is_refused(put):
    with pytest.raises(ImageError, match="4 samples"):
        read_image(put("a.tif", encoded(".tif", np.dstack([COLOUR, GREY8]))))


def test_one_bit_tiff_becomes_black_and_white(put):
    bits = RNG.integers(0, 2, (8, 16), dtype=np.uint8)
    packed = np.packbits(bits, axis=1)
    for photometric, expected in ((1, bits * 255), (0, 255 - bits * 255)):
        tags = {"t256": 16, "t258": 1, "t262": photometric}
        path = put("a.tif", tiff(packed, **tags))
        assert np.array_equal(read_image(path).pixels, expected)


def test_float_tiff_is_refused(put):
    floats = np.full((4, 6), np.nan, np.float32)
    with pytest.raises(ImageError, match="floating-point pixels of 32 bits"):
        read_image(put("a.tif", encoded(".tif", floats)))


def test_pages_are_chosen_one_by_one(put):
    pages = [GREY8, GREY16[:9], SMOOTH]
    path = put("a.tif", tiff(*pages))
    with pytest.raises(ImageError, match="3 images in one file"):
        read_image(path)
    for number, pixels in enumerate(pages):
        assert np.array_equal(read_image(path, page=number).pixels, pixels)
    with pytest.raises(ImageError, match="page 3 is asked for, the file has 3 pages"):
        read_image(path, page=3)
    with pytest.raises(InputError, match="page is -1"):
        read_image(path, page=-1)
    with pytest.raises(ImageError, match="has only page 0"):
        read_image(put("a.png", encoded(".png", GREY8)), page=1)


def test_wrong_ending_is_read_by_content_with_a_warning(put):
    with pytest.warns(CloseRangeWarning, match="PNG file by its content, not what '.jpg' says"):
        frame = read_image(put("a.jpg", encoded(".png", GREY8)))
    assert np.array_equal(frame.pixels, GREY8)
    for name in ("cam1.10001", "image"):  # numbered names and no ending promise nothing
        assert read_image(put(name, encoded(".tif", GREY8))).size_px == (34, 25)


@pytest.mark.parametrize("ext", [".png", ".jpg", ".tif", ".bmp"])
def test_truncated_files_are_refused_in_silence(put, ext, capfd):
    content = encoded(ext, SMOOTH)
    for length in (10, 60, len(content) // 2, len(content) * 9 // 10, len(content) - 1):
        with pytest.raises(ImageError):
            read_image(put("a" + ext, content[:length]))
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("compression", [5, 8])
def test_a_damaged_strip_of_an_8_bit_tiff_is_refused(put, compression, capfd):
    """OpenCV returns this image with a part missing, and says nothing to its caller."""
    pixels = RNG.integers(0, 256, (120, 90), dtype=np.uint8)
    content = bytearray(encoded(".tif", pixels, cv2.IMWRITE_TIFF_COMPRESSION, compression))
    content[300:420] = b"\xff" * 120
    partial = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert partial is not None
    assert not np.array_equal(partial, pixels)
    capfd.readouterr()
    with pytest.raises(ImageError, match="damaged"):
        read_image(put("a.tif", bytes(content)))
    assert capfd.readouterr() == ("", "")


def test_missing_empty_and_folder_are_file_errors(tmp_path, put):
    with pytest.raises(FileError, match="no such file"):
        read_image(tmp_path / "none.png")
    with pytest.raises(FileError, match="empty"):
        read_image(put("a.png", b""))
    with pytest.raises(FileError):
        read_image(tmp_path)
    with pytest.raises(FileError):
        read_image("a\0b.png")


def test_a_giant_claim_in_a_small_file_costs_nothing(put):
    head = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for kind, body in ((b"IHDR", head), (b"IDAT", zlib.compress(bytes(9))), (b"IEND", b"")):
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        content += struct.pack(">I", len(body)) + kind + body + checksum
    path = put("a.png", content)
    tracemalloc.start()
    with pytest.raises(ImageError, match="3600000000 pixels, the limit is 200000000"):
        read_image(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20, f"{peak} bytes for a file of {len(content)}"


def test_the_pixel_limit_can_be_lowered(put):
    path = put("a.png", encoded(".png", GREY8))
    assert read_image(path, max_pixels=25 * 34).size_px == (34, 25)
    with pytest.raises(ImageError, match="34 x 25 = 850 pixels, the limit is 849"):
        read_image(path, max_pixels=849)


def test_the_log_level_comes_back_after_overlapping_readers():
    place = getattr(cv2.utils, "logging", cv2)
    before = place.getLogLevel()
    inside, leave = threading.Event(), threading.Event()

    def other():
        with _quiet_opencv():
            inside.set()
            leave.wait(5)

    thread = threading.Thread(target=other)
    thread.start()
    assert inside.wait(5)
    with _quiet_opencv():
        assert place.getLogLevel() == 0
    assert place.getLogLevel() == 0  # the other is still reading
    leave.set()
    thread.join()
    assert place.getLogLevel() == before


SEEDS = [
    encoded(".png", GREY8),
    encoded(".png", COLOUR),
    encoded(".jpg", SMOOTH),
    encoded(".bmp", GREY8),
    encoded(".tif", SMOOTH),
    tiff(GREY8, GREY16, strips=3),
    tiff(GREY8, strips=3, compress=True, predictor=2),
]


def with_png_checksums(content: bytes) -> bytes:
    """Repair the checksums of a mutated PNG, so that the mutation reaches the decoder."""
    fixed = bytearray(content)
    at = 8
    while at + 12 <= len(fixed):
        end = at + 12 + int.from_bytes(fixed[at : at + 4], "big")
        if end > len(fixed):
            break
        fixed[end - 4 : end] = zlib.crc32(fixed[at + 4 : end - 4]).to_bytes(4, "big")
        at = end
    return bytes(fixed)


@settings(
    max_examples=400,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    seed=st.sampled_from(SEEDS),
    edits=st.lists(
        st.tuples(st.integers(0, 10**6), st.sampled_from([0, 1, 2, 127, 128, 254, 255, None])),
        min_size=1,
        max_size=6,
    ),
    head=st.booleans(),
    cut=st.integers(0, 10**6) | st.none(),
)
def test_mutated_files_give_a_frame_or_our_error(tmp_path, seed, edits, head, cut):
    content = bytearray(seed)
    reach = min(len(content), 64) if head else len(content)
    for at, value in edits:
        content[at % reach] = value if value is not None else (at // reach) % 256
    if cut is not None:
        del content[cut % len(content) :]
    content = with_png_checksums(content) if content[:4] == b"\x89PNG" else bytes(content)
    path = tmp_path / "mutant"
    path.write_bytes(content)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        try:
            frame = read_image(path, page=0, max_pixels=10**6)
        except CloseRangeError as error:
            assert error.remedy or isinstance(error, FileError)  # noqa: PT017 - both are allowed
        else:
            assert isinstance(frame, Frame)
            assert 0 < frame.pixels.size <= 10**6
