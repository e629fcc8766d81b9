"""The verb `match` in Python, and what is made of its matches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import closerange as cr
from closerange.errors import InputError
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.matching.matches_table import read_matches
from closerange.matching.volume_proposal import propose_volume
from closerange.position.suspicion import DoubtWarning
from closerange.workflows.match import Wanted, edge_names, match_images
from closerange.workflows.match_inputs import read_seeds, volume_of
from closerange.workflows.wire_frame import neighbours, write_wire_frame


@pytest.fixture(scope="module")
def frames(box_scene):
    return {name: cr.Frame(name, pixels) for name, pixels in box_scene.images.items()}


@pytest.fixture(scope="module")
def matches(box_scene, frames):
    return cr.match(box_scene.rig, frames, edges=True, placement="part")


def test_edges_are_the_default_and_named_along_their_chains(box_scene, frames, matches):
    steps = []
    again = cr.match(box_scene.rig, frames, progress=lambda *step: steps.append(step))
    assert steps == [(1, 1)]
    assert again.point == matches.point
    np.testing.assert_array_equal(again.xy_px, matches.xy_px)
    assert set(matches.placement) == {"part"}
    near = neighbours(matches.point, np.zeros((len(matches), 3)))
    assert len(near) > 0.8 * len(matches)
    way = np.linalg.norm(np.diff(matches.xy_px[near, 0], axis=1)[:, 0], axis=1)
    assert way.max() < 4.0, "neighbours in name are neighbours in the image"


def test_heights_of_the_boxes_come_out(box_scene, matches):
    """Tops at 8, 15 and 22 mm: the median error of their edges is below 0.05 mm."""
    positions = cr.measure(box_scene.rig, matches)
    good = positions.flags == 0
    assert good.sum() > 400
    for _, _, _, _, _, top in box_scene.boxes:
        near = good & (np.abs(positions.xyz_mm[:, 2] - top) < 0.5)
        assert near.sum() > 30
        assert abs(np.median(positions.xyz_mm[near, 2]) - top) < 0.05


def test_seeds_choose_the_reference_and_keep_their_rows(box_scene, frames, matches):
    rows = np.flatnonzero(matches.clean)[:40:4]
    seeds = ImagePoints.of(
        camera="right", point=[f"s{r}" for r in rows], xy_px=matches.xy_px[rows, 1],
        placement="now", reading="2",
    )  # fmt: skip
    found = cr.match(box_scene.rig, frames, points=seeds)
    assert found.cameras == ("right", "left")
    assert set(found.placement) == {"now"}
    assert set(found.reading) == {"2"}
    np.testing.assert_array_equal(found.xy_px[:, 0], seeds.xy_px)
    assert np.isnan(found.cov_px2[:, 0]).all()
    back = np.linalg.norm(found.xy_px[:, 1] - matches.xy_px[rows, 0], axis=1)
    assert np.nanmedian(back) < 0.3


def test_of_matches_the_first_cameras_points_are_the_seeds(box_scene, frames, matches):
    some = matches.select(np.flatnonzero(matches.clean)[:20])
    found = cr.match(box_scene.rig, frames, points=some)
    assert found.point == some.point
    assert found.cameras == ("left", "right")
    np.testing.assert_array_equal(found.xy_px[:, 0], some.xy_px[:, 0])


def test_the_literal_method_states_what_its_rounding_does(box_scene, frames, matches):
    some = matches.select(np.flatnonzero(matches.clean)[::10])
    found = cr.match(
        box_scene.rig, frames, points=some, method="literal", element_px=21, z_mm=(-22, 26)
    )
    place = found.xy_px[found.found[:, 1], 1]
    assert len(place) > 0.9 * len(some)
    np.testing.assert_array_equal(place, np.rint(place))
    np.testing.assert_allclose(found.cov_px2[found.found[:, 1], 1, 0, 0], 1 / 6)
    near = np.linalg.norm(found.xy_px[:, 1] - some.xy_px[:, 1], axis=1)
    assert np.nanmedian(near) < 1.5


def test_corners_go_the_same_way(box_scene, frames):
    corners = cr.match(box_scene.rig, frames, corners=True, placement="part")
    assert corners.clean.sum() >= 6
    assert set(corners.placement) == {"part"}
    assert cr.measure(box_scene.rig, corners).measured.sum() >= 6


def test_exchanged_images_are_warned_of(box_scene, frames):
    left, right = frames["left"].pixels, frames["right"].pixels
    with pytest.warns(DoubtWarning, match="exchanged"):
        found = cr.match(
            box_scene.rig, {"left": cr.Frame("left", right), "right": cr.Frame("right", left)}
        )
    assert not found.clean.any()
    with pytest.raises(InputError, match=r"'left' says that it is of camera 'right'"):
        cr.match(box_scene.rig, {"left": frames["right"], "right": frames["left"]})


def test_the_wire_frame_links_neighbours(tmp_path, box_scene, matches):
    matches.to_csv(tmp_path / "m.csv")
    drawn = write_wire_frame(box_scene.rig, read_matches(tmp_path / "m.csv"), tmp_path / "w.ply")
    assert 0.95 * matches.clean.sum() <= drawn.vertices <= matches.clean.sum()
    assert drawn.lines > 0.8 * drawn.vertices
    none = write_wire_frame(box_scene.rig, matches.select(~matches.clean), tmp_path / "n.ply")
    assert none.vertices == none.lines == 0


def test_neighbours_by_hand():
    names = ["e1.0", "e1.1", "e1.3", "e2.4", "e12.5", "p", "e2.5", "e1.2", "e1.4"]
    xyz = np.zeros((9, 3))
    xyz[:, 0] = [0.0, 1, 3, 0, 0, 0, 1, 2, 90]
    pairs = {tuple(pair) for pair in neighbours(names, xyz)}
    assert pairs == {(0, 1), (1, 7), (7, 2), (3, 6)}, "the last of e1 lies far away"
    assert neighbours(["a", "b"], np.zeros((2, 3))).shape == (0, 2)
    assert edge_names(np.array([1, -1, -1]), np.array([0, 1, 2])) == ["e0.0", "e0.1", "e1.0"]


def test_volumes_and_seeds_by_hand(box_scene):
    rig = box_scene.rig
    pair = ("left", "right")
    volume, origin = volume_of(rig, pair)
    assert volume is rig.volume_mm
    assert origin == "rig"
    lifted, origin = volume_of(rig, pair, z_mm=(-5.0, 7.0))
    assert lifted[:, 2].tolist() == [-5.0, 7.0]
    assert np.isinf(lifted[:, :2]).all()
    assert origin == "stated"
    stated, origin = volume_of(rig, pair, volume_mm=[1, 2, 3, 4, 5, 6])
    assert stated.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert origin == "stated"
    lost = ImagePoints.of(camera="left", point=["a", "b"], xy_px=[[1, 2], [np.nan, np.nan]])
    assert read_seeds(lost, {"left": 1}, None).flags.tolist() == [0, Flag.not_found]


def test_a_flat_volume_of_the_rig_is_replaced_by_a_proposal(box_scene, frames, matches):
    """Control points in one plane leave no room for a part."""
    low, high = box_scene.rig.volume_mm.copy()
    low[2] = high[2] = 0.0
    flat = replace(box_scene.rig, volume_mm=[low, high])
    matched = match_images(flat, frames, Wanted())
    assert matched.volume_origin == "proposed"
    np.testing.assert_array_equal(matched.volume_mm, propose_volume(flat))
    # the proposal is larger than the rig's own volume: a few points find a second answer
    assert matched.matches.clean.sum() > 0.8 * matches.clean.sum()
