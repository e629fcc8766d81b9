"""A drawing that can be written as SVG and painted into pixels."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np

from closerange.delivery.canvas import Canvas, base64_of, dot_layer, encode_png
from closerange.delivery.wording import DASH, TIMES


def canvas():
    return Canvas(40, 30, "title", "description")


def colour_at(pixels, x, y, scale=4):
    """Return red, green, blue in the middle of a place given in drawing units."""
    return pixels[int(y * scale), int(x * scale)][::-1].tolist()


def test_shapes_are_painted_where_the_svg_has_them():
    drawn = canvas()
    drawn.add("rect", x=2, y=2, width=10, height=6, fill="#ff0000")
    drawn.dot((30, 10), 3, "#00ff00")
    drawn.line((2, 20), (20, 20), "#0000ff", stroke_width=2)
    drawn.path([(25, 20), (35, 20), (35, 28)], closed=True, fill="#123456")
    pixels = drawn.paint(4)
    assert pixels.shape == (120, 160, 3)
    assert colour_at(pixels, 7, 5) == [255, 0, 0]
    assert colour_at(pixels, 30, 10) == [0, 255, 0]
    assert colour_at(pixels, 11, 20) == [0, 0, 255]
    assert colour_at(pixels, 33, 22) == [0x12, 0x34, 0x56]
    assert colour_at(pixels, 20, 28) == [255, 255, 255]
    svg = drawn.render()
    assert svg.count("<rect") == svg.count("<circle") == svg.count("<polygon") == 1


def test_many_marks_are_one_element_and_each_is_painted():
    drawn = canvas()
    drawn.dots([(5, 5), (15, 5), (25, 5)], 1.5, "#00aa00")
    drawn.squares([(5, 15), (15, 15)], 4, fill="#aa0000")
    drawn.segments([((2, 25), (10, 25)), ((20, 25), (30, 25))], "#0000aa", 2)
    svg = str(drawn.render())
    assert svg.count("<path") == 3
    assert 'd="M5 5h0M15 5h0M25 5h0"' in svg
    assert "M3 13h4v4h-4z" in svg
    pixels = drawn.paint(4)
    for x in (5, 15, 25):
        assert colour_at(pixels, x, 5) == [0, 170, 0]
    for x in (5, 15):
        assert colour_at(pixels, x, 15) == [170, 0, 0]
    assert colour_at(pixels, 25, 25) == [0, 0, 170]
    assert colour_at(pixels, 15, 25) == [255, 255, 255]


def test_no_marks_are_no_element():
    drawn = canvas()
    drawn.dots([], 1, "#000000")
    drawn.segments([], "#000000", 1)
    assert "<path" not in drawn.render()
    assert (drawn.paint() == 255).all()


def test_opacity_mixes():
    drawn = canvas()
    drawn.add("rect", x=0, y=0, width=40, height=30, fill="#000000", fill_opacity=0.5)
    assert abs(int(drawn.paint(1)[15, 20, 0]) - 128) <= 1


def test_a_picture_is_put_into_its_rectangle_and_a_layer_over_it():
    grey = np.full((10, 10), 90, np.uint8)
    layer = dot_layer((20, 20), np.array([[9.5, 9.5], [np.nan, 3]]), ["#ff0000"] * 2, radius=4)
    drawn = canvas()
    drawn.picture((0, 0), (20, 20), base64_of(encode_png(grey)), "png")
    drawn.picture((0, 0), (20, 20), layer, "png")
    pixels = drawn.paint(4)
    assert colour_at(pixels, 10, 10) == [255, 0, 0]
    assert colour_at(pixels, 2, 2) == [90, 90, 90]
    assert colour_at(pixels, 30, 10) == [255, 255, 255]
    assert drawn.render().count("data:image/png;base64,") == 2


def test_a_broken_picture_is_left_out():
    drawn = canvas()
    drawn.picture((0, 0), (10, 10), base64_of(b"no picture"), "jpeg")
    assert (drawn.paint() == 255).all()


def test_the_size_of_a_layer_does_not_grow_with_the_points():
    xy = np.random.default_rng(1).uniform(0, 640, (20_000, 2))
    many = dot_layer((640, 640), xy, ["#00ff00"] * 20_000, radius=1.3)
    assert len(many) < 640 * 640  # half a megabyte of circles otherwise
    decoded = cv2.imdecode(np.frombuffer(base64.b64decode(many), np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded.shape == (640, 640, 4)


def test_texts_are_painted_at_their_anchor_in_letters_that_the_painter_has():
    drawn = Canvas(200, 40, "t", "d")
    drawn.text((100, 20), f"12 µm {TIMES} 3 {DASH} ±", text_anchor="middle")
    drawn.text((190, 38), "end", text_anchor="end", fill="#ff0000")
    dark = np.argwhere((drawn.paint(2) < 128).any(axis=2))
    assert abs(dark[dark[:, 0] < 44][:, 1].mean() - 200) < 30
    assert dark[:, 1].max() <= 2 * 190 + 2
    assert "µm" in drawn.render()


def test_texts_of_the_page_are_escaped():
    drawn = canvas()
    drawn.text((1, 1), "<script>&")
    assert not re.search("<script>", drawn.render())
