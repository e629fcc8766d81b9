"""Bad image files through the command line: items 1 to 15 of the list of bad inputs.

Each test is named after its item and feeds the file itself. Good images are those that come with
the package: a plate of nine discs, 640 x 512 px, 8 bits.
"""

from __future__ import annotations

import json
import struct
import zlib

import cv2
import numpy as np
import pytest


def test_the_good_image_gives_nine_points_and_no_warning(detected, good_image):
    outcome, rows = detected(good_image)
    assert (outcome.code, outcome.stderr) == (0, "")
    assert [row["point"] for row in rows] == [f"r{r}c{c}" for r in range(3) for c in range(3)]
    assert rows.flags == [set()] * 9


def test_item_01_missing_image(refused, looking, tmp_path):
    refused(looking(tmp_path / "none.png"), 2, "none.png", "o such file")


def test_item_01_folder_without_images(refused, looking, tmp_path):
    (tmp_path / "empty").mkdir()
    refused(looking(tmp_path / "empty"), 2, "empty")


def test_item_01_missing_target(refused, looking, tmp_path, good_image):
    image = good_image
    refused(looking(image, target=tmp_path / "none.toml"), 2, "none.toml")


@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp"])
def test_item_02_empty_file(refused, looking, tmp_path, ending):
    path = tmp_path / f"image.{ending}"
    path.touch()
    refused(looking(path), 2, path.name, "empty")


@pytest.mark.parametrize("share", [0.001, 0.3, 0.7, 0.98])
@pytest.mark.parametrize("ending", ["png", "jpg", "tif", "bmp"])
def test_item_03_truncated_file(refused, looking, good, tmp_path, ending, share, save):
    path = save(tmp_path / f"image.{ending}", good)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(looking(path), 2, path.name)


def test_item_03_one_bad_image_among_good_ones(refused, looking, good, tmp_path, save, good_image):
    bad = save(tmp_path / "bad.png", good)
    bad.write_bytes(bad.read_bytes()[:5000])
    refused(looking(good_image, bad), 2, "bad.png")


@pytest.mark.parametrize(
    "content", [b"GIF89a" + bytes(99), b"%PDF-1.7\n", b"\x80\x04\x95", b"text"]
)
def test_item_04_no_image_at_all(refused, looking, tmp_path, content):
    path = tmp_path / "image.png"
    path.write_bytes(content)
    refused(looking(path), 2, "image.png")


@pytest.mark.parametrize(("real", "claimed"), [("png", "tif"), ("tif", "png"), ("bmp", "jpg")])
def test_item_04_wrong_ending_is_read_by_content(
    detected, good, truth, tmp_path, real, claimed, save
):
    path = tmp_path / f"image.{claimed}"
    save(tmp_path / f"image.{real}", good).rename(path)
    outcome, rows = detected(path)
    assert outcome.code == 0
    name = {"tif": "TIFF"}.get(real, real.upper())
    assert f"warning: {path}: is a {name} file by its content" in outcome.stderr
    np.testing.assert_array_equal(rows.xy, truth)


def png_of(width, height):
    """Return a PNG whose header claims a size, with hardly any pixels."""

    def chunk(kind, body):
        check = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + check

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    pixels = zlib.compress(bytes(100))
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(100_000, 100_000), (2**31 - 1, 2**31 - 1), (30_000, 30_000)])
def test_item_05_giant_header(refused, looking, tmp_path, size, monkeypatch):
    def never(*_args, **_kwargs):
        raise AssertionError("the pixels were decoded")

    monkeypatch.setattr(cv2, "imdecode", never)
    path = tmp_path / "bomb.png"
    path.write_bytes(png_of(*size))
    refused(looking(path), 2, "bomb.png", str(size[0]))


def test_item_06_tiff_of_several_pages(refused, looking, good, tmp_path):
    path = tmp_path / "pages.tif"
    assert cv2.imwritemulti(str(path), [good, good, good])
    refused(looking(path), 2, "pages.tif", "3 images", "page")


@pytest.mark.parametrize("value", [0.5, np.nan, np.inf])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_item_07_floating_point_pixels(refused, looking, good, tmp_path, value, kind, save):
    pixels = good.astype(kind)
    pixels[100:110, 100:110] = value
    refused(looking(save(tmp_path / "float.tif", pixels)), 2, "float.tif")


@pytest.mark.parametrize("ending", ["png", "tif"])
def test_item_07_sixteen_bits_are_kept(detected, good, truth, tmp_path, ending, save):
    """Grey values that 8 bits would all make 0 or 1: only the low byte holds the picture."""
    outcome, rows = detected(save(tmp_path / f"deep.{ending}", good.astype(np.uint16)))
    assert (outcome.code, outcome.stderr) == (0, "")
    np.testing.assert_allclose(rows.xy, truth, atol=1e-3)


def tiff_of(pixels, photometric):
    """Return an uncompressed TIFF of one strip."""
    height, width = pixels.shape
    bits = 8 * pixels.dtype.itemsize
    entries = [
        (256, 4, width), (257, 4, height), (258, 3, bits), (259, 3, 1), (262, 3, photometric),
        (273, 4, 8), (277, 3, 1), (278, 4, height), (279, 4, pixels.nbytes),
    ]  # fmt: skip
    directory = struct.pack("<H", len(entries))
    for tag, kind, value in entries:
        directory += struct.pack("<HHII", tag, kind, 1, value)
    body = pixels.astype(pixels.dtype.newbyteorder("<")).tobytes()
    return b"II*\0" + struct.pack("<I", 8 + len(body)) + body + directory + bytes(4)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("photometric", [0, 1])
def test_item_08_white_is_zero(detected, good, truth, tmp_path, kind, photometric):
    """Both files show white discs; the plate is "white-on-dark"."""
    pixels = good.astype(kind) * (257 if kind is np.uint16 else 1)
    stored = pixels if photometric else np.invert(pixels)
    path = tmp_path / "image.tif"
    path.write_bytes(tiff_of(stored.astype(kind), photometric))
    outcome, rows = detected(path)
    assert outcome.code == 0
    np.testing.assert_allclose(rows.xy, truth, atol=1e-3)


@pytest.mark.parametrize("orientation", [3, 6])
def test_item_09_exif_rotation_is_not_applied(detected, good, tmp_path, orientation, save):
    path = save(tmp_path / "phone.jpg", good, cv2.IMWRITE_JPEG_QUALITY, 95)
    _, plain = detected(path)
    jpeg = path.read_bytes()
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHIHHI", 0x112, 3, 1, orientation, 0, 0)
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])
    outcome, rows = detected(path)
    assert outcome.code == 0
    assert f"orientation tag {orientation}" in outcome.stderr
    assert "not applied" in outcome.stderr.replace("\n", " ")
    np.testing.assert_array_equal(rows.xy, plain.xy)


def test_item_10_colour_becomes_grey_by_the_documented_rule(detected, good, truth, tmp_path, save):
    outcome, rows = detected(save(tmp_path / "colour.png", cv2.cvtColor(good, cv2.COLOR_GRAY2BGR)))
    assert outcome.code == 0
    assert "0.299 R + 0.587 G + 0.114 B" in outcome.stderr
    np.testing.assert_allclose(rows.xy, truth, atol=1e-6)


def test_item_12_saturated_target_is_flagged(detected, good, tmp_path, save):
    """Every row is flagged: the table is written all the same, the exit code is 1."""
    bright = np.clip(good.astype(np.int32) * 4, 0, 255).astype(np.uint8)
    outcome, rows = detected(save(tmp_path / "bright.png", bright))
    assert outcome.code == 1
    assert "saturated, the limit is 1%" in outcome.stderr
    assert all("saturated" in names for names in rows.flags)
    assert np.isfinite(rows.xy).all()


@pytest.mark.parametrize("level", [0, 128, 255])
def test_item_13_uniform_image(refused, looking, good, tmp_path, level, save):
    refused(looking(save(tmp_path / "u.png", np.full_like(good, level))), 1, "u.png", "uniform")


def test_item_13_noise_without_structure(refused, looking, good, tmp_path, save):
    noise = np.random.default_rng(1).normal(120, 3, good.shape).round().astype(np.uint8)
    refused(looking(save(tmp_path / "lens-cap.png", noise)), 1, "lens-cap.png", "lens cap")


def test_item_13_structure_but_no_target(refused, looking, good, tmp_path, save):
    edge = np.where(np.arange(good.shape[1]) < 300, 40, 200).astype(np.uint8)
    image = save(tmp_path / "edge.png", np.broadcast_to(edge, good.shape).copy())
    refused(looking(image), 1, "edge.png")


def test_item_14_blur_is_told(detected, good, tmp_path, save):
    blurred = cv2.GaussianBlur(good, None, 14)
    outcome, rows = detected(save(tmp_path / "blurred.png", blurred))
    assert "warning: " in outcome.stderr
    assert "focus the lens" in outcome.stderr
    assert all("blurred" in names for names in rows.flags if "not_found" not in names)


def test_item_15_interlace_comb_is_told(detected, good, tmp_path, save):
    combed = good.copy()
    combed[1::2] = np.roll(good[1::2], 4, axis=1)  # the second field, 4 px later
    outcome, _ = detected(save(tmp_path / "fields.png", combed))
    assert "warning: " in outcome.stderr
    assert "interlaced" in outcome.stderr


def test_warnings_stand_in_the_json_summary(run, looking, good, tmp_path, save):
    image = save(tmp_path / "colour.png", cv2.cvtColor(good, cv2.COLOR_GRAY2BGR))
    outcome = run(*looking(image), "--json", "-o", tmp_path / "points.csv")
    (warning,) = json.loads(outcome.stdout)["warnings"]
    assert f"warning: {warning}" in outcome.stderr
    assert "colours turned to grey" in warning


def test_errors_stand_in_the_json_summary(run, looking, tmp_path):
    outcome = run(*looking(tmp_path / "none.png"), "--json", "-o", tmp_path / "points.csv")
    document = json.loads(outcome.stdout)
    assert document["error"]["exit_code"] == outcome.code == 2
    assert "none.png" in document["error"]["message"]
    assert document["error"]["remedy"]
