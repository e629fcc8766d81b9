from xml.etree import ElementTree as ET

import numpy as np
import pytest

from closerange.delivery.plots import (
    Level,
    Panel,
    axis_panels,
    magnification,
    panel_grid,
    vector_plot,
)
from closerange.delivery.svg import FULL_WIDTH


def _parse(svg):
    return ET.fromstring(str(svg))  # noqa: S314 - our own drawing


def _texts(svg):
    return [text.text for text in _parse(svg).iter("text")]


def test_panel_marks_lie_where_the_values_are():
    x = np.array([0.0, 1.0, 2.0, 3.0])
    panel = Panel(x, 2 * x, "x [mm]", "y [µm]", "line")
    svg = panel_grid([panel], columns=1, height=200, title="t", description="d")
    dots = [(float(c.get("cx")), float(c.get("cy"))) for c in _parse(svg).iter("circle")]
    assert len(dots) == 4
    px, py = np.array(dots).T
    assert np.allclose(np.diff(px), np.diff(px)[0], atol=0.02)
    assert np.allclose(np.diff(py), np.diff(py)[0], atol=0.02)
    assert np.diff(py)[0] < 0  # upwards
    assert {"x [mm]", "y [µm]", "line"} <= set(_texts(svg))


def test_unknown_values_are_left_out_and_an_empty_panel_says_so():
    panel = Panel(np.array([1.0, 2.0]), np.array([np.nan, 1.0]), "a [s]", "b [mm]", "one")
    empty = Panel(np.empty(0), np.empty(0), "a [s]", "b [mm]", "none", trend=(0.0, 1.0))
    svg = panel_grid([panel, empty], columns=2, height=150, title="t", description="d")
    assert len(list(_parse(svg).iter("circle"))) == 1
    assert "no value" in _texts(svg)
    assert "nan" not in str(svg).lower()


def test_levels_are_drawn_named_and_unknown_ones_left_out():
    values = np.column_stack([np.arange(5.0), np.arange(5.0), np.arange(5.0)])
    levels = [(Level(2.0, "pooled"), Level(np.nan, "limit", dashed=True))] * 3
    panels = axis_panels(
        values, unit="µm", quantity="std", x_label="number", levels=levels, mark="stem", zero=True
    )
    svg = panel_grid(panels, columns=1, height=110, title="t", description="d")
    texts = _texts(svg)
    assert texts.count("pooled") == 3
    assert "limit" not in texts
    assert [f"{axis}: std" in texts for axis in "XYZ"] == [True] * 3
    assert [f"{axis} [µm]" in texts for axis in "XYZ"] == [True] * 3


def test_everything_stays_inside_the_drawing():
    rng = np.random.default_rng(1)
    panels = axis_panels(rng.normal(0, 4, (90, 3)), unit="µm", quantity="error", x_label="number")
    root = _parse(panel_grid(panels, columns=1, height=110, title="t", description="d"))
    for circle in root.iter("circle"):
        assert 0 <= float(circle.get("cx")) <= FULL_WIDTH
        assert 0 <= float(circle.get("cy")) <= 330


@pytest.mark.parametrize(
    ("length", "factor"), [(0.01, 5000.0), (0.016, 3000.0), (0.5, 100.0), (100.0, 0.5)]
)
def test_magnification_is_round_and_keeps_vectors_off_each_other(length, factor):
    found = magnification(np.full(30, length), (640, 480))
    assert found == pytest.approx(factor, rel=0.01)
    apart = np.sqrt(640 * 480 / 30)
    assert 0.3 * apart < found * length <= 0.5 * apart + 1e-9


def test_magnification_of_a_few_vectors_stays_below_a_tenth_of_the_width():
    assert 4 < magnification(np.full(270, 10.0), (640, 480), count=9) * 10.0 <= 64


def test_counts_have_no_ticks_between_whole_numbers():
    few = Panel(np.array([1.0, 2.0]), np.array([0.0, 1.0]), "number", "y [mm]", "few")
    texts = _texts(panel_grid([few], columns=1, height=150, title="t", description="d"))
    assert {"1", "2"} <= set(texts)
    assert "1.5" not in texts
    part = Panel(np.array([0.5, 2.0]), np.array([0.0, 1.0]), "x [mm]", "y [mm]", "part")
    assert "1.4" in _texts(panel_grid([part], columns=1, height=150, title="t", description="d"))


def test_bars_reach_as_far_as_stated_and_unknown_ones_are_left_out():
    y, half = np.array([0.0, 1.0, 2.0]), np.array([1.0, np.nan, 2.0])
    panel = Panel(np.arange(1.0, 4.0), y, "n", "y [mm]", "bars", colour="#123456", spread=half)
    root = _parse(panel_grid([panel], columns=1, height=200, title="t", description="d"))
    bars = [line for line in root.iter("line") if line.get("stroke") == "#123456"]
    lengths = [abs(float(bar.get("y1")) - float(bar.get("y2"))) for bar in bars]
    assert len(bars) == 2
    assert lengths[1] == pytest.approx(2 * lengths[0], rel=0.01)


def test_magnification_survives_blunders_and_nothing():
    lengths = np.full(30, 0.01)
    lengths[0] = 50.0
    assert magnification(lengths, (640, 480)) == magnification(lengths[1:], (640, 480))
    assert magnification([np.nan, 0.0], (640, 480)) == 1.0


def test_vector_plot_points_along_the_residuals_at_the_stated_scale():
    svg = vector_plot(
        [[100.0, 100.0], [300.0, 200.0]],
        [[0.02, 0.0], [0.0, 9.0]],
        size_px=(640, 480),
        odd=np.array([False, True]),
        factor=1000.0,
        title="Residuals",
        description="d",
    )
    root = _parse(svg)
    feet = [(float(c.get("cx")), float(c.get("cy"))) for c in root.iter("circle")]
    tips = [poly.get("points").split()[0].split(",") for poly in root.iter("polygon")]
    tips = [(float(x), float(y)) for x, y in tips]
    drawn_px_per_unit = (FULL_WIDTH / 2 - 56) / 640
    assert tips[0][0] - feet[0][0] == pytest.approx(20 * drawn_px_per_unit, abs=0.02)
    assert tips[0][1] == pytest.approx(feet[0][1], abs=0.02)
    frame = next(rect for rect in root.iter("rect"))
    bottom = float(frame.get("y")) + float(frame.get("height"))
    assert tips[1][1] == pytest.approx(bottom, abs=0.02)  # a blunder is cut at the frame
    texts = _texts(svg)
    assert "not fitted (dashed)" in texts
    assert any(text.startswith("= ") and text.endswith(" px") for text in texts)


def test_length_of_the_key_is_what_it_says():
    for factor in (7.0, 100.0, 1000.0, 30000.0):
        svg = vector_plot(
            [[1.0, 1.0]],
            [[0.0, 0.0]],
            size_px=(640, 480),
            odd=np.array([False]),
            factor=factor,
            title="R",
            description="d",
        )
        words = next(text for text in _texts(svg) if text.startswith("= "))
        stated = float(words.removeprefix("= ").removesuffix(" px"))
        tip = list(_parse(svg).iter("polygon"))[-1].get("points").split()[0].split(",")
        drawn = (float(tip[0]) - 46) / (factor * (FULL_WIDTH / 2 - 56) / 640)
        assert drawn == pytest.approx(stated, rel=0.01)
        assert 5 < float(tip[0]) - 46 <= 61
