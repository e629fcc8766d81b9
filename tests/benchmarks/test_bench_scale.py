"""The benchmark of size: its drawn scenes have the truth they say, and it measures one."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from bench_scale import growth, measured, table
from closerange.features.edges import find_edges
from matching.box_scenes import BASE_PX, box_scene


@pytest.fixture(scope="module")
def scene():
    return box_scene(0.8, 2)


def test_visible_box_edges_are_edges_of_both_images(scene):
    for image, camera in zip(scene.images, scene.cameras, strict=True):
        edges = find_edges(image).xy_px
        away, _ = cKDTree(edges).query(camera.project(scene.edge_mm))
        # corners are rounded, and two faces may be equally bright
        assert np.mean(away < 1.0) > 0.9
        assert np.median(away) < 0.4


def test_the_truth_is_the_same_edge_seen_by_the_other_camera(scene):
    first, second = scene.cameras
    truth = scene.truth(first.project(scene.edge_mm[::7]))
    np.testing.assert_allclose(truth, second.project(scene.edge_mm[::7]), atol=1e-9)
    assert np.isnan(scene.truth(np.array([[2.0, 2.0]]))).all()


def test_scenes_grow_and_repeat(scene):
    again, larger = box_scene(0.8, 2), box_scene(1.6, 2)
    np.testing.assert_array_equal(again.images[0], scene.images[0])
    assert larger.cameras[0].size_px == tuple(round(1.6 * side) for side in BASE_PX)
    ratio = len(larger.edge_mm) / len(scene.edge_mm)
    assert ratio == pytest.approx(2.0, rel=0.1)


def test_it_measures(scene):
    figures = measured(scene, 1)
    assert figures.known > 500
    assert figures.candidates >= figures.points
    assert figures.right > 0.7
    assert figures.kept_right > 0.95
    assert figures.peer is not None
    text = "\n".join(table([figures]))
    assert f"{figures.size_px[0]} x {figures.size_px[1]}" in text
    assert growth([figures]) == ""
