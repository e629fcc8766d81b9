import base64
import json
from xml.etree import ElementTree as ET

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from closerange.delivery.overlays import (
    MAX_WIDTH_PX,
    Overlay,
    common_factor,
    draw_overlay,
    make_overlay,
)
from closerange.errors import InputError, SchemaError
from closerange.features.image_points import ImagePoints
from closerange.files import parse_json
from closerange.flags import Flag
from closerange.images.frame import Frame


def _parse(svg):
    return ET.fromstring(str(svg))  # noqa: S314 - our own drawing


def _frame(width=640, height=480, dtype=np.uint8, camera="left"):
    ramp = np.linspace(0, 200, width).astype(dtype)
    return Frame(camera, np.broadcast_to(ramp, (height, width)).copy(), source="left_1.png")


def _picture(overlay):
    content = np.frombuffer(base64.b64decode(overlay.picture), np.uint8)
    return cv2.imdecode(content, cv2.IMREAD_UNCHANGED)


def test_round_trip_through_json_is_exact(points, rig):
    overlay = make_overlay(_frame(), points, residuals=rig.residuals)
    text = json.dumps(overlay.to_document(), allow_nan=False)
    again = Overlay.from_document(parse_json(text, source="run.json"))
    for name in ("xy_px", "ellipse", "flags", "residual_px"):
        assert_array_equal(getattr(again, name), getattr(overlay, name))
    assert (again.camera, again.placement, again.source) == ("left", "z0", "left_1.png")
    assert again.point == overlay.point
    assert draw_overlay(again) == draw_overlay(overlay)


def test_only_the_frames_camera_is_taken(points, rig):
    overlay = make_overlay(_frame(), points, residuals=rig.residuals)
    assert len(overlay.point) == 27
    assert_array_equal(overlay.residual_px, rig.residuals.residual_px[:27])


def test_points_without_residual_have_none(points):
    overlay = make_overlay(_frame(), points)
    assert np.isnan(overlay.residual_px).all()
    assert common_factor([overlay]) == 1.0


def test_placement_must_be_named_where_there_are_several():
    several = ImagePoints.of(
        camera="left", point=["a", "a"], placement=["1", "2"], xy_px=[[1, 1], [2, 2]]
    )
    with pytest.raises(InputError, match="2 placements"):
        make_overlay(_frame(), several)
    assert make_overlay(_frame(), several, placement="2").xy_px.tolist() == [[2, 2]]
    assert make_overlay(_frame(), several, placement="3").point == ()


def test_one_reading_is_shown():
    several = ImagePoints.of(
        camera="left", point=["a", "a"], reading=["1", "2"], xy_px=[[1, 1], [2, 2]]
    )
    assert make_overlay(_frame(), several).xy_px.tolist() == [[1, 1]]
    assert make_overlay(_frame(), several, reading="2").xy_px.tolist() == [[2, 2]]


def test_large_frames_are_made_small_but_keep_their_coordinates():
    points = ImagePoints.of(camera="left", point=["a"], xy_px=[[1919.5, 0.0]])
    overlay = make_overlay(_frame(1920, 1080), points)
    assert _picture(overlay).shape == (360, MAX_WIDTH_PX)
    assert overlay.size_px == (1920, 1080)
    root = _parse(draw_overlay(overlay))
    # pixel 1919.5 is the right edge of the last pixel, hence of the picture
    lines = [(float(line.get("x1")) + float(line.get("x2"))) / 2 for line in root.iter("line")]
    assert lines[0] == pytest.approx(320, abs=0.01)


def test_sixteen_bits_become_visible():
    pixels = np.zeros((20, 30), np.uint16)
    pixels[:, 15:] = 4095  # a 12-bit camera
    overlay = make_overlay(
        Frame("left", pixels), ImagePoints.of(camera="left", point=[], xy_px=np.empty((0, 2)))
    )
    assert _picture(overlay).max() > 250


def test_ellipse_is_drawn_where_and_as_large_as_it_is(points):
    root = _parse(draw_overlay(make_overlay(_frame(), points)))
    ellipses = list(root.iter("ellipse"))
    assert len(ellipses) == 2 * 25  # dark and bright; one point is not found, one has no ellipse
    first = ellipses[0]
    scale = 320 / 640
    assert float(first.get("rx")) == pytest.approx(12 * scale)
    assert float(first.get("cx")) == pytest.approx((points.xy_px[0, 0] + 0.5) * scale, abs=0.01)
    assert first.get("transform").startswith("rotate(22.92 ")


def test_names_and_flags_are_escaped_and_shown(points):
    svg = str(draw_overlay(make_overlay(_frame(), points)))
    texts = [text.text for text in _parse(svg).iter("text")]
    assert "a<b>&\"c': saturated" in texts
    assert "<b>" not in svg


def test_residuals_are_magnified_by_the_common_factor(points, rig):
    overlay = make_overlay(_frame(), points, residuals=rig.residuals)
    # 27 points are 107 px apart, half of it is 53 px; 90 % of the residuals are below 0.06 px
    assert common_factor([overlay, overlay]) == pytest.approx(700)
    drawn = draw_overlay(overlay, factor=500.0)
    assert drawn != draw_overlay(overlay, factor=100.0)


def test_malformed_documents_are_refused(points):
    document = make_overlay(_frame(), points).to_document()
    for change in (
        {"schema": "other"},
        {"picture_jpeg_base64": '"/><script>'},
        {"xy_px": [[1, 2]]},
        {"size_px": [1]},
        {"flags": ["x"] * 27},
        {"point": None},
    ):
        with pytest.raises(SchemaError):
            Overlay.from_document({**document, **change})
    del document["camera"]
    with pytest.raises(SchemaError, match="camera"):
        Overlay.from_document(document)


def test_flags_survive_as_bits(points):
    overlay = make_overlay(_frame(), points)
    assert overlay.flags[0] == Flag.saturated
