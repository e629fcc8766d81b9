"""Corners of one view found in another: where edges meet in space."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.flags import Flag
from closerange.matching.corner_matcher import match_corners
from closerange.matching.matcher import views_of


@pytest.fixture(scope="module")
def matches(box_scene):
    views = views_of(box_scene.rig.cameras, list(box_scene.images.values()))
    return match_corners(views, box_scene.rig.volume_mm)


def true_corners(boxes):
    corners = []
    for x, y, long, wide, turn, top in boxes:
        c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
        for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            dx, dy = sx * long / 2, sy * wide / 2
            corners.append((x + c * dx - s * dy, y + s * dx + c * dy, top))
    return np.array(corners)


def test_corners_of_the_boxes_tops_are_found_within_their_covariance(matches, box_scene):
    left, right = box_scene.rig.cameras
    xyz = true_corners(box_scene.boxes)
    apart = np.linalg.norm(matches.xy_px[:, 0, None] - left.project(xyz), axis=2)
    nearest = apart.argmin(axis=1)
    tops = np.flatnonzero(matches.clean & (apart.min(axis=1) < 1.0))
    assert len(tops) >= 6
    miss = matches.xy_px[tops, 1] - right.project(xyz)[nearest[tops]]
    assert np.linalg.norm(miss, axis=1).max() < 0.5
    # a match is stated given its corner: what that is off by in the first view comes on top
    cov = matches.cov_px2[tops, 1] + matches.cov_px2[tops, 0]
    squared = np.einsum("ni,nij,nj->n", miss, np.linalg.inv(cov), miss)
    assert np.median(squared) < 2.0
    assert (squared < 11.8).all(), "three standard deviations"


def test_rows_without_a_place_have_a_reason(matches):
    assert matches.point == tuple(f"c{row}" for row in range(len(matches)))
    assert (matches.found[:, 0]).all()
    assert ((matches.flags[:, 1] != 0) | matches.found[:, 1]).all()


def test_images_without_corners_give_no_rows(box_scene):
    blank = np.full((256, 320), 40, np.uint8)
    right = box_scene.images["right"]
    assert len(match_corners(views_of(box_scene.rig.cameras, [blank, right]),
                             box_scene.rig.volume_mm)) == 0  # fmt: skip
    left = box_scene.images["left"]
    alone = match_corners(views_of(box_scene.rig.cameras, [left, blank]), box_scene.rig.volume_mm)
    assert len(alone) > 5
    assert not alone.matched.any()
    assert (alone.flags[:, 1] & Flag.no_edge).all()
