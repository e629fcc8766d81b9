import re
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from closerange.delivery.common_view_plot import draw_common_view
from closerange.delivery.common_view_section import common_view_section
from closerange.delivery.report import render_report
from closerange.delivery.sheet import Contents, Figure, Paragraph, Table
from closerange.delivery.svg import INK, PURPLE
from closerange.matching.proposed_volume import survey_volume
from closerange.verification.scenes import SyntheticRig, looking_at_origin


@pytest.fixture(scope="module")
def proposal():
    cameras = tuple(
        looking_at_origin(
            name, angle_rad=angle, distance_mm=500.0, focal_px=1400.0, size_px=(640, 512)
        )
        for name, angle in (("left", -0.3), ("right", 0.3))
    )
    volume = np.array([[-30.0, -20.0, -10.0], [30.0, 20.0, 10.0]])
    return survey_volume(SyntheticRig("s", cameras, volume, 0.05).true_rig())


def test_the_section_says_and_shows_both_volumes(proposal):
    section = common_view_section(Contents("t", proposal=proposal))
    first, table, advice, figure = section.blocks
    assert isinstance(first, Paragraph)
    assert "100.0 % lies in it" in first.text
    assert isinstance(table, Table)
    assert [row[0] for row in table.rows] == ["X", "Y", "Z"]
    assert table.rows[0][1:4] == ("-30.0", "30.0", "60.0")
    shown = [float(row[5]) - float(row[4]) for row in table.rows]
    np.testing.assert_allclose(shown, proposal.volume_mm[1] - proposal.volume_mm[0], atol=0.11)
    assert isinstance(advice, Paragraph)
    assert "calibrate --volume" in advice.text
    assert isinstance(figure, Figure)
    texts = [text.text for text in ET.fromstring(str(figure.picture)).iter("text")]  # noqa: S314
    assert {"proposed volume", "calibrated volume"} <= set(texts)


def test_without_a_proposal_there_is_no_section(proposal):
    assert common_view_section(Contents("t")) is None
    assert 'id="common-view"' not in render_report(title="t")
    page = render_report(title="t", proposal=proposal)
    assert 'id="common-view"' in page
    assert "nan" not in re.sub(r"<style.*?</style>", "", page, flags=re.DOTALL).lower()


def test_the_calibrated_volume_is_dashed_and_ends_at_the_frame(proposal):
    """A volume ten times as large must not shrink what the picture is about."""
    huge = 10 * proposal.volume_mm
    drawing = draw_common_view(
        proposal.cameras, proposal.view, proposal.volume_mm, calibrated_mm=huge
    )
    root = ET.fromstring(str(drawing.render()))  # noqa: S314 - our own drawing
    dashes = [path for path in root.iter("path") if path.get("stroke") == INK]
    assert len(dashes) == 4
    boxes = [
        np.array([[float(v) for v in pair.split(",")] for pair in shape.get("points").split()])
        for shape in root.iter("polygon")
        if shape.get("stroke") == PURPLE
    ]
    frames = [
        [float(rect.get(name)) for name in ("x", "y", "width", "height")]
        for rect in root.iter("rect")
    ]
    for path, (x, y, width, height) in zip(dashes, frames, strict=True):
        ends = np.array([float(v) for v in re.findall(r"-?[\d.]+", path.get("d"))]).reshape(-1, 2)
        assert (ends >= np.array([x, y]) - 0.02).all()
        assert (ends <= np.array([x + width, y + height]) + 0.02).all()
    for box in boxes[2:]:
        assert np.ptp(box, axis=0).max() > 60, "a third of the picture's height"


def test_it_is_painted_too(proposal):
    drawing = draw_common_view(proposal.cameras, proposal.view, proposal.volume_mm)
    pixels = drawing.paint(1.0)
    assert pixels.shape == (round(drawing.height), 640, 3)
    assert (pixels < 200).any(axis=2).mean() > 0.01
    texts = [text.text for text in ET.fromstring(str(drawing.render())).iter("text")]  # noqa: S314
    assert "volume" in texts
    assert "calibrated volume" not in texts
