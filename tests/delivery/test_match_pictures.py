"""Pictures of a matched scene: what is stored, and how it is drawn."""

from __future__ import annotations

import base64
import json
import re

import cv2
import numpy as np
import pytest

from closerange.delivery.match_drawings import (
    KEPT,
    depth_limits,
    draw_depths,
    draw_element,
    draw_flags,
    draw_strengths,
    flag_classes,
)
from closerange.delivery.match_pictures import (
    ScenePictures,
    ViewPicture,
    dimmed,
    scene_pictures,
)
from closerange.errors import SchemaError
from closerange.features.edge_operators import edge_mask
from closerange.flags import Flag
from closerange.images.frame import Frame
from closerange.matching.correspondences import Correspondences
from closerange.matching.search import epipolar_segment


@pytest.fixture(scope="module")
def frames(box_scene):
    return [Frame(name, pixels, None, f"{name}.png") for name, pixels in box_scene.images.items()]


@pytest.fixture(scope="module")
def true_matches(box_scene):
    """Every third edge pixel of the left view with the exact match in the right one."""
    mask, _ = edge_mask(box_scene.images["left"])
    xy = np.argwhere(mask)[::3, ::-1].astype(float)
    left, right = box_scene.rig.cameras
    height = box_scene.nearest_height(left, xy)
    direction = left.directions(xy)
    way = (height - left.centre_mm[2]) / direction[:, 2]
    there = right.project(left.centre_mm + way[:, None] * direction)
    flags = np.zeros((len(xy), 2), int)
    flags[::5, 1] = Flag.aperture
    flags[::10, 1] |= Flag.occluded
    lost = np.zeros(len(xy), bool)
    lost[3::20] = True
    flags[lost, 1] = Flag.no_edge
    there[lost] = np.nan
    return Correspondences.of(
        cameras=["left", "right"],
        point=[f"e0.{i}" for i in range(len(xy))],
        xy_px=np.stack([xy, there], axis=1),
        flags=flags,
    )


@pytest.fixture(scope="module")
def scene(box_scene, frames, true_matches):
    rig = box_scene.rig
    return scene_pictures(rig, frames, true_matches, rig.volume_mm)


def test_a_scene_holds_both_views_and_their_thresholds(scene, frames):
    assert [view.camera for view in scene.views] == ["left", "right"]
    for view, frame in zip(scene.views, frames, strict=True):
        mask, report = edge_mask(frame.pixels)
        assert view.threshold == report.threshold
        assert view.edge_share == pytest.approx(mask.mean())
        assert view.size_px == frame.size_px == (320, 256)
        grey = cv2.imdecode(np.frombuffer(base64.b64decode(view.grey), np.uint8), 0)
        assert grey.shape == (256, 320)
        assert grey.max() < 160  # half of white, and what JPEG adds


def test_strength_pictures_tell_edge_pixels_by_colour(scene, frames):
    picture = cv2.imdecode(np.frombuffer(base64.b64decode(scene.views[0].strength), np.uint8), 1)
    mask, _ = edge_mask(frames[0].pixels)
    colourful = np.ptp(picture.astype(int), axis=2)
    assert np.median(colourful[mask]) > 25  # measured 36: many lie just above the threshold
    assert (
        np.median(colourful[~cv2.dilate(mask.astype(np.uint8), np.ones((17, 17))).astype(bool)]) < 3
    )


def test_the_element_is_cut_around_its_point_and_found_on_its_segment(
    scene, box_scene, true_matches
):
    element = scene.element
    row = true_matches.point.index(element.point)
    assert true_matches.clean[row]
    mask = {name: edge_mask(pixels)[0] for name, pixels in box_scene.images.items()}
    centre = np.rint(true_matches.xy_px[row, 0]).astype(int)
    half = element.size_px // 2
    assert (np.abs(element.element_px - centre) <= half).all()
    x0, y0 = centre - half
    window = mask["left"][y0 : y0 + element.size_px, x0 : x0 + element.size_px]
    assert len(element.element_px) == window.sum()
    x, y = element.mapped_px.T
    np.testing.assert_array_equal(element.missing, ~mask["right"][y, x])
    assert element.missing.sum() == element.mismatch.min()
    segment = epipolar_segment(
        *box_scene.rig.cameras, true_matches.xy_px[row, :1], box_scene.rig.volume_mm
    )
    np.testing.assert_allclose(element.segment_px, segment.xy_px[0, : segment.count[0]], atol=1e-3)
    # the place with the fewest missing pixels is the true one, to the pixel
    best = element.segment_px[np.argmin(element.mismatch)]
    assert np.linalg.norm(best - true_matches.xy_px[row, 1]) < 1.5
    height = box_scene.nearest_height(box_scene.rig.cameras[0], true_matches.xy_px[row, :1])[0]
    assert element.depth_mm[np.argmin(element.mismatch)] == pytest.approx(height, abs=1.5)


def test_a_scene_survives_its_document(scene):
    document = json.loads(json.dumps(scene.to_document()))
    again = ScenePictures.from_document(document)
    assert again.to_document() == scene.to_document()
    assert draw_element(again.element).render() == draw_element(scene.element).render()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda d: d.update(schema="closerange.overlay/1"),
        lambda d: d.pop("views"),
        lambda d: d["views"][0].update(grey_jpeg_base64="<script>"),
        lambda d: d["views"][0].update(size_px=[1]),
        lambda d: d.update(volume_mm=[[0, 0, 0]]),
        lambda d: d["element"].update(mismatch=[1]),
        lambda d: d["element"]["crops"].pop(),
        lambda d: d["element"]["crops"][0].update(png_base64="%"),
        lambda d: d["element"].update(missing=[]),
        lambda d: d.update(centroids=[{"point": "a"}]),
    ],
)
def test_a_spoilt_document_is_refused(scene, spoil):
    document = json.loads(json.dumps(scene.to_document()))
    spoil(document)
    with pytest.raises(SchemaError):
        ScenePictures.from_document(document)


def test_without_a_limit_in_depth_or_a_kept_match_there_is_no_element(
    box_scene, frames, true_matches
):
    rig = box_scene.rig
    endless = np.array([[-np.inf] * 3, [np.inf] * 3])
    scene = scene_pictures(rig, frames, true_matches, endless)
    assert scene.element is None
    assert scene.volume_mm == ((None,) * 3, (None,) * 3)
    bad = true_matches.select(np.flatnonzero(~true_matches.clean))
    assert scene_pictures(rig, frames, bad, rig.volume_mm).element is None


def test_dimming_keeps_order_and_uses_the_range_of_the_camera():
    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert (np.diff(dimmed(grey).ravel().astype(int)) >= 0).all()
    assert dimmed(grey).max() == 128
    deep = (grey.astype(np.uint16)) * 16  # 12 bits
    assert np.abs(dimmed(deep).astype(int) - dimmed(grey)).max() <= 1


def test_classes_of_flags_hold_every_point_once():
    a, b, c = int(Flag.ambiguous), int(Flag.aperture), int(Flag.residual)
    flags = np.array([0, a, a | b, b, a | b | c, 0, a])
    classes = flag_classes(flags)
    assert [(entry.label, entry.count) for entry in classes] == [
        ("kept, no flag", 2), ("ambiguous", 2), ("aperture", 2), ("residual", 1),
    ]  # fmt: skip
    assert sorted(row for entry in classes for row in entry.rows) == list(range(7))
    assert classes[0].colour == KEPT
    assert len({entry.colour for entry in classes}) == 4


def test_more_flags_than_colours_share_the_last():
    flags = np.array([1 << bit for bit in range(12)])
    classes = flag_classes(flags)
    assert classes[-1].label == "other flags"
    assert sum(entry.count for entry in classes) == 12


def test_thousands_of_points_are_a_few_elements(scene, true_matches):
    count = 9
    marks = [np.tile(true_matches.xy_px[:, column], (count, 1)) for column in (0, 1)]
    flags = np.tile(true_matches.point_flags, count)
    assert len(flags) > 3000
    svg = str(draw_flags(scene.views, marks, flags).render())
    assert svg.count("<circle") <= 10  # the legend's
    assert svg.count("<image") == 4
    assert len(svg) < 250_000


def test_the_depth_picture_colours_points_where_they_are(scene):
    view = scene.views[0]
    xy = np.array([[60.0, 50.0], [250.0, 200.0]])
    canvas = draw_depths([view], [xy], np.array([0.0, 10.0]), "Z")
    pixels = canvas.paint(2)
    scale = 2 * 639 / 320
    for (x, y), blue_over_red in zip(xy, (True, False), strict=True):
        blue, _, red = pixels[int(2 * 17 + (y + 0.5) * scale), int((x + 0.5) * scale)].astype(int)
        assert (blue > red) == blue_over_red
    assert "Z [mm] of 2 points without a flag" in canvas.render()


def test_limits_of_depth():
    depth = np.concatenate([np.linspace(0, 10, 1001), [1e6, np.nan]])
    low, high = depth_limits(depth)
    assert 0 <= low < 0.2
    assert 9.8 < high <= 10
    assert depth_limits(np.array([3.0, 3.0])) == (2.5, 3.5)
    assert depth_limits(np.array([])) == (0, 1)


def test_drawings_say_what_they_show(scene):
    svg = str(draw_strengths(scene.views).render())
    assert len(re.findall(r"threshold [\d.]+ grey levels", svg)) == 2
    element = str(draw_element(scene.element).render())
    assert "left: element, " in element
    assert "missing in the second view" in element
    assert draw_element(scene.element).paint().std() > 20


def test_three_views_are_laid_out_in_two_rows(scene):
    first = scene.views[0]
    third = ViewPicture("third", "", first.size_px, first.grey, first.strength, 1.0, 0.1)
    canvas = draw_strengths([*scene.views, third])
    assert canvas.height > 1.8 * draw_strengths(scene.views).height
    assert "third: threshold" in canvas.render()
