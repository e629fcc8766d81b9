import math
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from closerange.delivery.svg import (
    Drawing,
    Scale,
    heat_colour,
    heat_legend,
    ink_on,
    nice_step,
    tick_text,
    ticks,
    units,
    widened,
)


def _parse(svg):
    return ET.fromstring(str(svg))  # noqa: S314 - our own drawing


def test_drawing_is_well_formed_and_escaped():
    drawing = Drawing(100, 50, 'a<b & "c"', "d>e")
    drawing.text((1, 2), "<script>&'\"", text_anchor="middle")
    drawing.arrow((0, 0), (10, 0), "#000000", stroke_width=2)
    root = _parse(drawing.render())
    assert root.find("title").text == 'a<b & "c"'
    assert root.find("desc").text == "d>e"
    assert root.find("text").text == "<script>&'\""
    assert root.attrib["role"] == "img"
    assert root.attrib["viewBox"] == "0 0 100 50"


def test_arrow_of_no_length_draws_nothing_and_short_ones_keep_their_tip():
    drawing = Drawing(10, 10, "t", "d")
    drawing.arrow((5, 5), (5, 5), "#000000")
    root = _parse(drawing.render())
    assert [child.tag for child in root] == ["title", "desc"]
    drawing.arrow((0, 0), (1, 0), "#000000")
    root = _parse(drawing.render())
    assert root.find("polygon").attrib["points"].split()[0] == "1,0"


@pytest.mark.parametrize(
    ("span", "count", "step"), [(1, 5, 0.2), (0.2, 2, 0.1), (97, 5, 20), (3, 1, 5), (0, 4, 1.0)]
)
def test_nice_step(span, count, step):
    assert nice_step(span, count) == pytest.approx(step)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-0.13, 0.12), (-1e-7, 3e-7), (995.2, 1003.1)])
def test_ticks_lie_inside_and_are_evenly_spaced(low, high):
    found = ticks(low, high, 5)
    assert 2 <= len(found) <= 6
    assert low - 1e-9 * abs(low) <= found[0]
    assert found[-1] <= high + 1e-9 * abs(high)
    assert np.allclose(np.diff(found), nice_step(high - low, 5))


def test_tick_text_has_the_decimals_of_its_step_and_no_negative_zero():
    assert tick_text(0.1 * 3, 0.1) == "0.3"
    assert tick_text(-1e-17, 0.05) == "0.00"
    assert tick_text(40.0, 20.0) == "40"


def test_units_are_short():
    assert units(1.0) == "1"
    assert units(-0.001) == "0"
    assert units(2.346) == "2.35"


@pytest.mark.parametrize("values", [[], [math.nan], [3.0], [0.0, 0.0], [-1, 2, math.nan]])
def test_widened_range_is_never_empty(values):
    low, high = widened(values)
    assert low < high
    assert all(low <= value <= high for value in values if math.isfinite(value))


def test_widened_range_from_zero_starts_there():
    assert widened([1.0, 2.0], zero=True)[0] == 0
    low, high = widened([-1.0, 2.0], zero=True)
    assert low < -1 < 2 < high


def test_scale_is_linear():
    scale = Scale(-1, 3, 100, 20)
    assert scale(-1) == 100
    assert scale(3) == 20
    assert scale(1) == 60


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_heat_scale_survives_a_grey_printer():
    luminance = [_luminance(heat_colour(x)) for x in np.linspace(0, 1, 101)]
    assert (np.diff(luminance) < 0).all()
    assert luminance[0] - luminance[-1] > 0.8  # measured 0.89


def test_numbers_in_cells_have_contrast():
    for fraction in np.linspace(0, 1, 101):
        back, ink = _luminance(heat_colour(fraction)), _luminance(ink_on(fraction))
        bright, dark = max(back, ink), min(back, ink)
        assert (bright + 0.05) / (dark + 0.05) > 4.5  # WCAG AA for small text; smallest 4.6


def test_unknown_value_is_grey():
    assert heat_colour(math.nan) == "#e6e6e6"


def test_legend_says_what_the_colour_means():
    drawing = Drawing(300, 60, "t", "d")
    heat_legend(drawing, (10, 20), 200, (0.0, 20.0), "error [µm]")
    texts = [text.text for text in _parse(drawing.render()).iter("text")]
    assert texts == ["0", "5", "10", "15", "20", "error [µm]"]
