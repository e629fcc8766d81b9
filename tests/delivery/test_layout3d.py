from xml.etree import ElementTree as ET

import numpy as np

from closerange.delivery.layout3d import Group, draw_layout, draw_points, draw_values, paper_up
from closerange.delivery.volume_plots import draw_slices, draw_volume
from closerange.delivery.wording import DASH
from closerange.verification.error_map import ErrorMap


def _parse(svg):
    return ET.fromstring(str(svg))  # noqa: S314 - our own drawing


def _texts(svg):
    return [text.text for text in _parse(svg).iter("text")]


def _inside(svg):
    root = _parse(svg)
    width, height = (float(root.get(name)) for name in ("width", "height"))
    pairs = [(c.get("cx"), c.get("cy")) for c in root.iter("circle")]
    pairs += [(line.get("x1"), line.get("y1")) for line in root.iter("line")]
    pairs += [(text.get("x"), text.get("y")) for text in root.iter("text")]
    return all(0 <= float(x) <= width and 0 <= float(y) <= height for x, y in pairs)


def test_layout_names_cameras_axes_and_unit(rig):
    svg = draw_layout(rig)
    texts = _texts(svg)
    assert {"left", "right", "X [mm]", "Y [mm]", "Z [mm]", "measuring volume"} <= set(texts)
    assert _inside(svg)
    assert _inside(draw_layout(rig, width=320))


def test_cameras_above_the_volume_are_drawn_above_it(rig):
    assert paper_up(rig.cameras, rig.volume_mm) == 1.0
    assert paper_up(rig.cameras, rig.volume_mm + np.array([0, 0, 5000])) == -1.0
    names = {text.text: float(text.get("y")) for text in _parse(draw_layout(rig)).iter("text")}
    assert max(names["left"], names["right"]) < names["X [mm]"]


def test_projection_keeps_parallels_and_handedness():
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [10, 10, 10]], float)
    for up in (1.0, -1.0):
        svg = draw_points(
            [Group("p", corners, [f"#00000{i}" for i in range(5)])],
            volume_mm=[[0, 0, 0], [10, 10, 10]],
            up=up,
            title="t",
            description="d",
        )
        dots = {c.get("fill"): c for c in _parse(svg).iter("circle") if c.get("r") == "2.6"}
        flat = np.array(
            [
                [float(dots[f"#00000{i}"].get("cx")), float(dots[f"#00000{i}"].get("cy"))]
                for i in range(5)
            ]
        )
        x, y, z = flat[1:4] - flat[0]
        assert np.allclose(flat[4] - flat[0], x + y + z, atol=0.05)
        assert np.sign(z[1]) == -up  # y on paper runs down
        # seen from above, X turns to Y counter-clockwise; from below, clockwise
        assert np.sign(x[1] * y[0] - x[0] * y[1]) == up


def test_points_with_nan_are_left_out():
    xyz = np.array([[0, 0, 0], [np.nan, 1, 1], [10, 10, 5.0]])
    svg = draw_values(
        xyz,
        [1.0, 2.0, np.nan],
        volume_mm=[[0, 0, 0], [10, 10, 10]],
        up=1.0,
        label="error [µm]",
        title="t",
        description="d",
    )
    assert len([c for c in _parse(svg).iter("circle") if c.get("r") == "4.2"]) == 2
    assert "nan" not in str(svg)
    assert "error [µm]" in _texts(svg)


def test_flat_and_single_volumes_can_be_drawn():
    for size in ([10, 10, 0], [0, 0, 0]):
        svg = draw_values(
            np.zeros((1, 3)),
            [0.0],
            volume_mm=[[0, 0, 0], size],
            up=1.0,
            label="error [µm]",
            title="t",
            description="d",
        )
        assert "nan" not in str(svg)
        assert _inside(svg)


def test_volume_shows_three_levels_with_legend_and_range(error_map):
    svg = draw_volume(error_map)
    texts = _texts(svg)
    assert [t for t in texts if t.startswith("Z =")] == ["Z = 40 mm", "Z = 0 mm", "Z = -40 mm"]
    assert any(t.endswith("[µm]") for t in texts)
    assert len([p for p in _parse(svg).iter("polygon") if p.get("stroke") == "#ffffff"]) == 75
    assert "#e6e6e6" in str(svg)  # the node that no two cameras see
    assert _inside(svg)


def test_slices_print_the_error_in_micrometres(error_map):
    texts = _texts(draw_slices(error_map, 1))
    assert texts.count("4.0") == 74
    assert "Y: one standard deviation of a position [µm]" in texts
    assert DASH in texts


def test_maps_without_any_value_or_depth_can_be_drawn():
    nodes = np.array([[x, y, 0.0] for x in (0, 1) for y in (0, 1)], float)
    unknown = np.full((4, 3), np.nan)
    flat = ErrorMap(nodes, (2, 2, 1), unknown, unknown)
    assert "nan" not in str(draw_volume(flat)) + str(draw_slices(flat, 0))
    one = ErrorMap(np.zeros((1, 3)), (1, 1, 1), np.full((1, 3), 0.01), np.full((1, 3), 0.01))
    assert "10" in _texts(draw_slices(one, 2))
