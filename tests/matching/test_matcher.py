"""All edges of one view found in another, on a drawn scene whose truth is known."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from closerange.errors import GeometryError, InputError
from closerange.features.edges import find_edges
from closerange.flags import Flag
from closerange.geometry.transform import RigidTransform
from closerange.matching.matcher import View, match_views, strong_edges, views_of
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal


@pytest.fixture(scope="module")
def views(box_scene):
    return views_of(box_scene.rig.cameras, list(box_scene.images.values()))


@pytest.fixture(scope="module")
def matches(views, box_scene):
    return match_views(views, box_scene.rig.volume_mm)


def truth(scene, seeds):
    left, right = scene.rig.cameras
    height = scene.nearest_height(left, seeds)
    direction = left.directions(seeds)
    way = (height - left.centre_mm[2]) / direction[:, 2]
    return right.project(left.centre_mm + way[:, None] * direction)


def test_nearly_all_edges_are_found_and_what_is_kept_is_right(matches, box_scene):
    """Within 1 px: 82 % of what has a place, all of what has no flag (97 % within 0.1 px).

    Points that no other view shows keep their best guess too, flagged.
    """
    error = np.linalg.norm(matches.xy_px[:, 1] - truth(box_scene, matches.xy_px[:, 0]), axis=1)
    found, clean = matches.found[:, 1], matches.clean
    assert len(matches) > 800
    assert (error[found] < 1.0).mean() > 0.75
    assert clean.mean() > 0.55
    assert (error[clean] < 1.0).mean() >= 0.99
    assert (error[clean] < 0.1).mean() > 0.9


def test_stated_covariances_hold(matches, box_scene):
    miss = matches.xy_px[:, 1] - truth(box_scene, matches.xy_px[:, 0])
    clean = matches.clean & (np.linalg.norm(miss, axis=1) < 1.0)
    cov = matches.cov_px2[clean, 1]
    assert (np.linalg.eigvalsh(cov) > 0).all()
    squared = np.einsum("ni,nij,nj->n", miss[clean], np.linalg.inv(cov), miss[clean])
    assert (squared < 5.99).mean() > 0.93
    assert np.sqrt(np.median(cov[:, 0, 0])) < 0.3


def test_edges_that_the_other_view_hides_are_not_made_up(matches, box_scene):
    """Feet of boxes behind other boxes: the second view sees something nearer there."""
    left, right = box_scene.rig.cameras
    seeds = matches.xy_px[:, 0]
    height = box_scene.nearest_height(left, seeds)
    direction = left.directions(seeds)
    way = (height - left.centre_mm[2]) / direction[:, 2]
    xyz = left.centre_mm + way[:, None] * direction
    there = right.project(xyz)
    seen_z = box_scene.nearest_height(right, there)
    hidden = seen_z > height + 3.0  # something stands at least 3 mm higher in front of it
    assert hidden.sum() > 10
    wrong = np.linalg.norm(matches.xy_px[:, 1] - there, axis=1) > 1.0
    assert not (hidden & wrong & matches.clean).any()


def test_every_row_has_a_place_or_a_reason(matches):
    assert ((matches.flags[:, 1] != 0) | matches.found[:, 1]).all()
    assert (matches.flags[:, 0] == 0).all()
    known = np.isfinite(matches.cov_px2).all(axis=(2, 3))
    assert (known == matches.found).all()
    assert (matches.mismatch[matches.clean] >= 0).all()


def test_given_points_on_edges_are_repeated_unmoved_and_found(views, matches, box_scene):
    rows = np.flatnonzero(matches.clean)[::9]
    seeds = matches.xy_px[rows, 0] + 0.3 * np.array([0.6, 0.8])
    cov = np.tile(0.01 * np.eye(2), (len(rows), 1, 1))
    names = [f"n{row}" for row in rows]
    steps = []
    found = match_views(
        views, box_scene.rig.volume_mm, seeds_px=seeds, seeds_cov_px2=cov, point=names,
        placement="now", progress=lambda *step: steps.append(step),
    )  # fmt: skip
    assert steps == [(1, 1)]
    assert found.point == tuple(names)
    assert set(found.placement) == {"now"}
    np.testing.assert_array_equal(found.xy_px[:, 0], seeds)
    np.testing.assert_array_equal(found.cov_px2[:, 0], cov)
    near = np.linalg.norm(found.xy_px[:, 1] - matches.xy_px[rows, 1], axis=1)
    assert np.nanmedian(near) < 0.6


def test_points_that_are_none_or_beside_the_image_are_flagged(views, box_scene):
    seeds = np.array([[np.nan, 3.0], [-9.0, 20.0], [1e9, 3.0], [160.0, 3.0]])
    found = match_views(views, box_scene.rig.volume_mm, seeds_px=seeds)
    assert not found.clean.any()
    assert (found.flags[:, 1] != 0).all()
    assert (found.flags[1:3, 0] & Flag.outside_image).all()
    none = match_views(views, box_scene.rig.volume_mm, seeds_px=np.zeros((0, 2)))
    assert len(none) == 0


def degenerate(kind):
    image = np.full((256, 320), 50, np.uint8)
    if kind == "one spot":
        image[100, 100] = 255
    if kind == "a chain of six":
        image[100:107, 200:203] = 200
    if kind == "noise":
        rng = np.random.default_rng(0)
        image = np.clip(rng.normal(50, 3, image.shape).round(), 0, 255).astype(np.uint8)
    if kind == "full scale":
        image[:] = 255
    return image


@pytest.mark.parametrize("kind", ["blank", "one spot", "a chain of six", "noise", "full scale"])
@pytest.mark.parametrize("which", ["both", "first", "second"])
def test_images_with_next_to_nothing_give_no_match(box_scene, kind, which):
    left, right = box_scene.images.values()
    images = [
        left if which == "second" else degenerate(kind),
        right if which == "first" else degenerate(kind),
    ]
    views = views_of(box_scene.rig.cameras, images)
    for seeds in (None, np.array([[160.0, 100.0], [np.nan, 0.0]])):
        found = match_views(views, box_scene.rig.volume_mm, seeds_px=seeds)
        same_bar = kind == "a chain of six" and which == "both"  # then they do match
        assert same_bar or not found.clean.any()
        assert same_bar or ((found.flags != 0).any(axis=1)).all()


def test_any_view_may_be_the_first_and_two_of_one_place_are_refused(box_scene, views):
    swapped = match_views(views[::-1], box_scene.rig.volume_mm)
    assert swapped.cameras == ("right", "left")
    assert swapped.clean.mean() > 0.5
    left = box_scene.rig.cameras[0]
    twin = View(replace(left, name="twin"), views[0].pixels, views[0].edges)
    with pytest.raises(InputError, match="0 mm apart"):
        match_views([views[0], twin], box_scene.rig.volume_mm)


def test_a_third_view_adds_a_column_and_agrees(shared):
    """Rendered blocks: rays of three cameras meet where those of two do."""
    folder = shared / "data" / "rendered" / "A_blocks"
    described = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["cameras"]
    names = ("left", "right", "third")
    images = [cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED) for name in names]
    cameras = []
    for name, image in zip(names, images, strict=True):
        camera = described[name]
        k1, k2, p1, p2, k3 = camera["dist_k1_k2_p1_p2_k3"]
        pose = RigidTransform(np.array(camera["R"]), np.array(camera["t_mm"]))
        lens = BrownIdeal(k1=k1, k2=k2, p1=p1, p2=p2, k3=k3)
        cameras.append(Camera(name, image.shape[::-1], np.array(camera["K"]), pose, lens))
    volume = np.array([[-75.0, -75, -52], [75, 75, 30]])
    three = match_views(views_of(cameras, images), volume)
    assert three.cameras == names
    assert three.clean.mean() > 0.4
    assert np.nanmin(three.mismatch) >= 0, "a table of matches holds no negative misfit"
    both = (three.flags == 0).all(axis=1)
    assert both.sum() > 500
    xyz, _ = intersect(three.xy_px[both], cameras)
    miss = np.stack([c.project(xyz) for c in cameras], axis=1) - three.xy_px[both]
    assert np.median(np.linalg.norm(miss, axis=2)) < 0.1


def intersect(xy_px, cameras):
    """Return points nearest to all rays, and their distances from them."""
    normal, right = np.zeros((len(xy_px), 3, 3)), np.zeros((len(xy_px), 3))
    for column, camera in enumerate(cameras):
        way = camera.directions(xy_px[:, column])
        across = np.eye(3) - way[:, :, None] * way[:, None, :]
        normal += across
        right += across @ camera.centre_mm
    xyz = np.linalg.solve(normal, right[..., None])[..., 0]
    return xyz, np.einsum("nij,nj->ni", normal, xyz) - right


def test_strong_edges_are_those_of_the_mask(box_scene):
    from closerange.features.edge_operators import edge_mask  # noqa: PLC0415

    pixels = box_scene.images["left"]
    edges = find_edges(pixels)
    strong = strong_edges(pixels, edges)
    mask, _ = edge_mask(pixels)
    column, row = np.rint(edges.xy_px).astype(int).T
    assert strong[mask[row, column]].all()
    assert 0.3 < strong.mean() <= 1.0


def test_views_and_volumes_that_are_none_are_refused(box_scene, views):
    cameras, images = box_scene.rig.cameras, list(box_scene.images.values())
    with pytest.raises(InputError, match="1 image; a match needs two"):
        views_of(cameras[:1], images[:1])
    with pytest.raises(InputError, match=r"'right'.*300 x 256.*320 x 256"):
        views_of(cameras, [images[0], images[1][:, :300]])
    with pytest.raises(GeometryError, match="behind it"):
        match_views(views, np.array([[-9, -9, 2000.0], [9, 9, 2100]]))
    with pytest.raises(InputError, match="lower limit"):
        match_views(views, np.array([[9, -9, -9.0], [-9, 9, 9]]))
