"""Images that cannot be those of the cameras they were given for."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

import closerange as cr
from closerange.errors import CloseRangeWarning, GeometryError
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.position.suspicion import DoubtWarning
from closerange.verification.scenes import SyntheticRig, looking_at_origin
from closerange.workflows.match import Wanted, match_images

METHODS = ("default", "literal")


def noisy(pixels, seed=8, scale=1.0):
    rng = np.random.default_rng(seed)
    grey = scale * pixels + rng.normal(0.0, 1.5, pixels.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def found(rig, left, right, **wanted):
    frames = {"left": cr.Frame("left", left), "right": cr.Frame("right", right)}
    return match_images(rig, frames, Wanted(**wanted))


@pytest.mark.parametrize("method", METHODS)
def test_two_exposures_of_one_camera_are_told(box_scene, method):
    """Identical pixels are refused; here noise and light differ, and every edge has a rival."""
    left = box_scene.images["left"]
    matched = found(box_scene.rig, left, noisy(left, scale=0.8), method=method)
    assert "show one view" in matched.doubt
    assert matched.remedy
    assert not matched.matches.clean.any()
    rows = matched.matches.found[:, 1]
    assert (matched.matches.flags[rows, 1] & Flag.ambiguous).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [3, None])
def test_exchanged_images_are_told_even_with_few_points(box_scene, method, count):
    left, right = box_scene.images["left"], box_scene.images["right"]
    points = None
    if count:  # on edges of the image that is given for the left camera
        good = found(box_scene.rig, left, right).matches
        xy = good.xy_px[np.flatnonzero(good.clean)[:: len(good) // 9][:count], 1]
        points = ImagePoints.of(camera="left", point=["a", "b", "c"], xy_px=xy)
    matched = found(box_scene.rig, right, left, method=method, points=points)
    assert "exchanged" in matched.doubt
    assert "the image given for 'left' is that of 'right'" in matched.doubt
    assert not matched.matches.clean.any()


def test_an_image_may_be_that_of_a_camera_that_was_not_named(box_scene):
    rig = box_scene.rig
    third = looking_at_origin(
        "third", angle_rad=0.9, distance_mm=800.0, focal_px=1900.0, size_px=(320, 256)
    )
    three = SyntheticRig("three", (*rig.cameras, third), rig.volume_mm, 0.05).true_rig()
    frames = {
        "left": cr.Frame("left", box_scene.images["left"]),
        "third": cr.Frame("third", box_scene.images["right"]),
    }
    with pytest.warns(DoubtWarning, match="given for 'third' is that of 'right'"):
        matches = cr.match(three, frames)
    assert not matches.clean.any()


@pytest.mark.parametrize("kind", ["blurred", "upside down"])
def test_the_literal_method_is_not_believed_where_nothing_else_matches(box_scene, kind):
    """It takes the best place of each point, however bad it is."""
    right = box_scene.images["right"]
    spoilt = cv2.GaussianBlur(right, (0, 0), 8.0) if kind == "blurred" else right[::-1, ::-1].copy()
    matched = found(box_scene.rig, box_scene.images["left"], noisy(spoilt), method="literal")
    assert "cannot tell a bad match from a good one" in matched.doubt
    assert not matched.matches.clean.any()


@pytest.mark.parametrize("method", METHODS)
def test_good_images_are_not_doubted(box_scene, method):
    matched = found(box_scene.rig, *box_scene.images.values(), method=method)
    assert matched.doubt == matched.remedy == ""
    assert matched.matches.clean.mean() > 0.4


def test_the_literal_method_too_refuses_a_volume_out_of_view(box_scene):
    with pytest.raises(GeometryError, match="which lies behind it"):
        found(box_scene.rig, *box_scene.images.values(), method="literal", z_mm=(2000, 2100))


def test_a_cause_that_is_evident_is_named(box_scene):
    bright = [np.clip(pixels.astype(int) * 6, 0, 255) for pixels in box_scene.images.values()]
    with pytest.warns(CloseRangeWarning, match="most are flagged saturated: lower the exposure"):
        found(box_scene.rig, *(pixels.astype(np.uint8) for pixels in bright))
    low, high = box_scene.rig.volume_mm
    away = replace(box_scene.rig, volume_mm=np.array([low, high]) + np.array([0, 0, 100]))
    with pytest.warns(CloseRangeWarning, match="no_edge|outside_volume"):
        found(away, *box_scene.images.values())


def test_a_part_that_fits_both_ways_is_told_and_kept(box_scene):
    """Two cameras in mirror symmetry see a plate: exchanged, it lies as far below as above."""
    cameras = [
        looking_at_origin(
            name, angle_rad=angle, distance_mm=800.0, focal_px=1900.0, size_px=(320, 256)
        )
        for name, angle in (("left", -0.22), ("right", 0.22))
    ]
    rig = SyntheticRig("s", tuple(cameras), box_scene.rig.volume_mm, 0.05).true_rig()
    corners = np.array([[-25.0, -20, 8], [25, -20, 8], [25, 20, 8], [-25, 20, 8]])
    images = []
    for camera in cameras:
        fine = np.zeros((8 * 256, 8 * 320), np.uint8)
        place = np.rint(16 * (8 * (camera.project(corners) + 0.5) - 0.5)).astype(np.int32)
        cv2.fillPoly(fine, [place], 255, cv2.LINE_8, 4)
        share = cv2.resize(fine, (320, 256), interpolation=cv2.INTER_AREA) / 255
        images.append(noisy(cv2.GaussianBlur(40 + 140 * share, (0, 0), 0.7), seed=len(images)))
    for left, right in (images, images[::-1]):
        with pytest.warns(CloseRangeWarning, match="would fit as well if they were exchanged"):
            matched = found(rig, left, right)
        assert matched.doubt == ""
        assert matched.matches.clean.sum() > 50


@pytest.mark.parametrize("kind", ["black", "another scene"])
def test_a_third_view_that_shows_nothing_of_the_part_is_named_and_loosens_nothing(box_scene, kind):
    third = looking_at_origin(
        "third", angle_rad=0.9, distance_mm=800.0, focal_px=1900.0, size_px=(320, 256)
    )
    rig = SyntheticRig(
        "three", (*box_scene.rig.cameras, third), box_scene.rig.volume_mm, 0.05
    ).true_rig()
    useless = np.full((256, 320), 20, np.uint8)
    if kind == "another scene":
        cv2.rectangle(useless, (60, 40), (250, 200), 180, 5)
    images = {name: cr.Frame(name, pixels) for name, pixels in box_scene.images.items()}
    alone = cr.match(rig, images)
    with pytest.warns(CloseRangeWarning, match="in camera 'third'"):
        both = cr.match(rig, {**images, "third": cr.Frame("third", noisy(useless))})
    kept = [found.found[:, 1] & (found.flags[:, 1] == 0) for found in (alone, both)]
    assert (kept[1] & ~kept[0]).sum() <= 0.01 * kept[0].sum()
