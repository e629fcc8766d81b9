"""The report's sections on matches and heights, and the wire frame in space."""

from __future__ import annotations

import re

import numpy as np
import pytest

from closerange.delivery.histograms import Histogram, draw_histograms
from closerange.delivery.match_pictures import scene_pictures
from closerange.delivery.match_section import ADVICE
from closerange.delivery.report import render_report
from closerange.delivery.wire import MOST_POINTS, draw_wire, neighbours, paper_colour
from closerange.delivery.wording import FLAG_WORDS
from closerange.errors import CloseRangeWarning
from closerange.flags import Flag
from closerange.images.frame import Frame
from closerange.matching.correspondences import Correspondences
from closerange.position.measure import measure_points
from closerange.verification.heights import height_test
from closerange.verification.known_parts import Parts


def matched(box_scene, count=60):
    """Return points on the outline of the first box's top with their exact matches."""
    x, y, long, wide, turn, top = box_scene.boxes[0]
    along = np.linspace(-0.5, 0.5, count // 2)
    own = np.concatenate(
        [np.column_stack([along * long, np.full(len(along), s * wide / 2)]) for s in (-1, 1)]
    )
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    xyz = np.column_stack([own @ np.array([[c, s], [-s, c]]) + (x, y), np.full(len(own), top)])
    xy = np.stack([camera.project(xyz) for camera in box_scene.rig.cameras], axis=1)
    flags = np.zeros((len(xyz), 2), int)
    flags[:5, 1] = Flag.ambiguous
    return Correspondences.of(
        cameras=["left", "right"],
        point=[f"e{row // (count // 2)}.{row % (count // 2)}" for row in range(len(xyz))],
        xy_px=xy,
        cov_px2=np.broadcast_to(0.05**2 * np.eye(2), (*xy.shape, 2)),
        mismatch=np.linspace(0, 2, len(xyz)),
        flags=flags,
    )


@pytest.fixture(scope="module")
def html(box_scene):
    rig, matches = box_scene.rig, matched(box_scene)
    frames = [Frame(name, pixels, None, name) for name, pixels in box_scene.images.items()]
    centroid = {"point": "face<1>", "seed_px": [1, 2], "match_px": [3, 4]}
    centroid |= {"expected_px": [3.5, 4.0], "found_px": [3.2, 4.4]}
    scene = scene_pictures(rig, frames, matches, rig.volume_mm, centroids=[centroid])
    positions = measure_points(rig, matches.to_image_points())
    x, y, long, wide, turn, top = box_scene.boxes[0]
    parts = Parts.of(
        ["box <a>"], ["box"], [[x, y, top]], [[long, wide]], height_mm=top + 20, rotation_deg=turn
    )
    return render_report(
        title="Scene",
        rig=rig,
        matches={"scene": matches},
        positions={"scene": positions},
        scenes={"scene": scene},
        checks=[{**height_test(positions, parts).to_document(), "job": "scene"}],
    )


def text_of(html):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", html))


def test_the_section_counts_and_explains(html):
    text = text_of(html)
    assert "60 points of camera left were sought in right, within X -48.0 to 48.0" in text
    assert "60 have a place in at least two views; 55 (91.7 %) were kept" in text
    assert f"ambiguous 5 {FLAG_WORDS[Flag.ambiguous]} {ADVICE[Flag.ambiguous]}" in text
    assert "Predicted standard deviation of kept points" in text
    assert "face&lt;1&gt; 1.00 2.00 3.00 4.00 3.50 4.00 3.20 4.40 0.500" in text
    assert "0.500 px apart (median), at most 0.500 px" in text


def test_the_pictures_are_in_the_page_and_need_nothing_else(html):
    section = html[html.index('id="matches-1"') :]
    assert section.count("<figure") >= 6
    assert not re.search(r'(href|src)="(?!data:|#)', section)
    assert "Matched edges in space" in section
    assert "points without a flag" in section


def test_heights_are_told_with_their_errors(html):
    text = text_of(html)
    assert "Heights: scene" in text
    row = re.search(r"box &lt;a&gt; box edge points of the top 55 28.000 ([\d.]+)", text)
    assert row is not None
    assert abs(float(row[1]) - 28) < 0.002
    assert "1 known height" in text
    assert "Error of a height (scene): at most" in text
    assert "55 of 60 matched points of job scene carry no flag; only these are used" in text


def test_flags_of_matches_are_no_reason_for_doubt(html):
    assert "carry a flag (see Flags)" not in text_of(html)


def test_a_missing_part_is_a_reservation(box_scene):
    matches = matched(box_scene)
    positions = measure_points(box_scene.rig, matches.to_image_points())
    x, y, long, wide, turn, top = box_scene.boxes[0]
    parts = Parts.of(
        ["a", "b"], ["box", "disc"], [[x, y, top], [200, 200, 5]], [[long, wide], [9, 9]],
        height_mm=25, rotation_deg=turn,
    )  # fmt: skip
    with pytest.warns(CloseRangeWarning, match="1 of 2 parts"):
        check = height_test(positions, parts)
    text = text_of(render_report(title="t", checks=[check]))
    assert "With reservations." in text
    assert "Parts without enough points: b." in text


def test_a_few_points_without_pictures_have_a_section_too():
    matches = Correspondences.of(
        cameras=["a", "b"], point=["p"], xy_px=[[[1, 2], [np.nan, np.nan]]], flags=[[0, 1 << 19]]
    )
    text = text_of(render_report(title="t", matches=matches))
    assert "1 point of camera a were sought in b" in text
    assert "no_edge 1" in text


def test_every_flag_that_a_match_may_carry_has_advice():
    names = "ambiguous aperture occluded poor_fit residual inconsistent no_edge outside_image"
    names += " at_border saturated near_parallel behind_camera untrusted"
    for name in names.split():
        assert ADVICE[Flag[name]]


def test_neighbours_follow_each_other_and_do_not_jump():
    names = ["e1.0", "e1.1", "e1.2", "e1.4", "e2.5", "corner", "e1.3"]
    xyz = np.array([[i, 0, 0] for i in (0, 1, 2, 40, 9, 9, 3)], float)
    assert sorted(map(tuple, neighbours(names, xyz).tolist())) == [(0, 1), (1, 2), (2, 6)]
    assert neighbours(["a"], xyz[:1]).shape == (0, 2)


def test_a_wire_frame_of_many_points_stays_small():
    count = 3 * MOST_POINTS
    xyz = np.random.default_rng(1).uniform(-40, 40, (count, 3))
    pairs = np.empty((0, 2), np.int64)
    box = np.array([[-50.0] * 3, [50.0] * 3])
    canvas = draw_wire(
        xyz, pairs, xyz[:, 2], volume_mm=box, up=1.0, limits=(-40, 40), label="Z [mm]"
    )
    svg = str(canvas.render())
    assert svg.count("<circle") == 0
    assert svg.count("<path") <= 24
    assert MOST_POINTS / 2 <= svg.count("h0") <= MOST_POINTS
    assert len(svg) < 200_000


def test_colours_on_paper_are_dark_enough_to_be_seen():
    for fraction in np.linspace(0, 1, 11):
        red, green, blue = (int(paper_colour(fraction)[i : i + 2], 16) for i in (1, 3, 5))
        assert 0.2126 * red + 0.7152 * green + 0.0722 * blue < 190


def test_bars_of_a_histogram_hold_every_value():
    values = np.concatenate([np.full(30, 1.0), np.full(20, 5.0), [1e9, np.nan]])
    svg = str(draw_histograms([Histogram("t", values, "x [mm]")]).render())
    assert "51 values, median 1.0" in svg
    heights = [float(h) for h in re.findall(r'<rect [^>]*height="([\d.]+)"[^>]*/>', svg)[:-1]]
    fills = len(re.findall(r'<rect fill="#0067a3"', svg))
    assert fills == 2
    assert heights[0] / heights[1] == pytest.approx(30 / 21, rel=0.01)


def test_equal_values_and_none_are_histograms_too():
    for values in (np.zeros(3), np.full(4, 7.0), np.array([np.nan])):
        svg = str(draw_histograms([Histogram("t", values, "x")]).render())
        assert "nan" not in svg
