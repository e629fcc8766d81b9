"""Candidates: crossings of epipolar curves with chains of edges in the other view."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.features.edges import find_edges
from closerange.matching import candidates as candidates_module
from closerange.matching import pencil as pencil_module
from closerange.matching.candidates import find_candidates, sweep_axis
from closerange.matching.pencil import Pencil


@pytest.fixture(scope="module")
def found(box_scene):
    first, second = box_scene.rig.cameras
    edges = [find_edges(box_scene.images[camera.name]) for camera in (first, second)]
    pencil = Pencil.of(first, second)
    return pencil, edges, find_candidates(pencil, *edges, box_scene.rig.volume_mm)


def test_a_candidate_is_seen_where_it_is_said_to_be_by_both_cameras(found):
    """Exact at the first; at the second the piece of chain is straight in theta, not in px."""
    pencil, edges, candidates = found
    assert len(candidates) > len(edges[0])
    seed = edges[0].xy_px[candidates.point]
    assert np.abs(pencil.first.project(candidates.xyz_mm) - seed).max() < 1e-6
    miss = pencil.second.project(candidates.xyz_mm) - candidates.xy_px
    assert np.abs(miss).max() < 1e-3


def test_candidates_lie_in_the_volume_on_the_chain_and_are_sorted(found, box_scene):
    _, edges, candidates = found
    low, high = box_scene.rig.volume_mm
    assert ((candidates.xyz_mm >= low) & (candidates.xyz_mm <= high)).all()
    assert (np.diff(candidates.point) >= 0).all()
    assert ((candidates.share >= 0) & (candidates.share <= 1)).all()
    after = edges[1].after[candidates.link]
    assert (after >= 0).all()
    a, b = edges[1].xy_px[candidates.link], edges[1].xy_px[after]
    np.testing.assert_allclose(candidates.xy_px, a + candidates.share[:, None] * (b - a), atol=1e-4)


@pytest.mark.parametrize("across", [np.inf, 12.0])
def test_no_crossing_is_missed(found, across):
    """Every ninth point against all pieces of chain, one by one."""
    pencil, (first, second), _ = found
    volume = np.array([[-across, -across, -30.0], [across, across, 25.0]])
    candidates = find_candidates(pencil, first, second, volume)
    theta, slope = pencil.coordinates(pencil.first, first.xy_px)
    theta_2, slope_2 = pencil.coordinates(pencil.second, second.xy_px)
    link = np.flatnonzero(second.after >= 0)
    after = second.after[link]
    for point in range(0, len(first), 9):
        share = (theta[point] - theta_2[link]) / (theta_2[after] - theta_2[link])
        rise = theta[first.after[point]] - theta[point] if first.after[point] >= 0 else 0.0
        rise += theta[point] - theta[first.before[point]] if first.before[point] >= 0 else 0.0
        crossed = (share >= 0) & (share <= 1) & (rise * (theta_2[after] - theta_2[link]) > 0)
        met = (slope_2[link] + share * (slope_2[after] - slope_2[link]))[crossed]
        one = np.ones(len(met))
        xyz = pencil.point(theta[point] * one, slope[point] * one, met)
        inside = ((xyz >= volume[0]) & (xyz <= volume[1])).all(axis=1)
        wanted = link[crossed][inside]
        assert sorted(candidates.link[candidates.point == point]) == sorted(wanted)


def test_pieces_of_the_work_make_no_difference(found, box_scene, monkeypatch):
    pencil, edges, whole = found
    monkeypatch.setattr(candidates_module, "PAIRS_AT_ONCE", 100)
    monkeypatch.setattr(candidates_module, "ROWS_AT_ONCE", 33)
    monkeypatch.setattr(pencil_module, "AT_ONCE", 77)
    pieces = find_candidates(pencil, *edges, box_scene.rig.volume_mm)
    np.testing.assert_array_equal(pieces.point, whole.point)
    np.testing.assert_array_equal(pieces.link, whole.link)
    np.testing.assert_allclose(pieces.xyz_mm, whole.xyz_mm, atol=1e-9)
    np.testing.assert_allclose(pieces.level, whole.level, atol=1e-6)


def test_the_bright_side_is_the_same_along_the_epipolar_curve(found):
    """Turning the first camera's edges round leaves no crossing of the same kind."""
    _, edges, candidates = found
    bright_2 = np.column_stack([candidates.tangent[:, 1], -candidates.tangent[:, 0]])
    expected = np.einsum("nij,nj->ni", candidates.level, edges[0].tangent[candidates.point])
    # the image of the bright side, by the mapping of the level plane, which keeps the hand
    bright_1 = np.column_stack([expected[:, 1], -expected[:, 0]])
    side_1 = np.sign(np.einsum("ni,ni->n", bright_1, candidates.epipolar))
    side_2 = np.sign(np.einsum("ni,ni->n", bright_2, candidates.epipolar))
    steep = candidates.sine > 0.2
    assert (side_1 == side_2)[steep].mean() > 0.98


def test_rates_and_directions_agree_with_finite_differences(found):
    pencil, _, candidates = found
    axis = sweep_axis(pencil)
    assert axis == 2
    rows = candidates.select(np.arange(0, len(candidates), 37))
    ray = rows.xyz_mm - pencil.first.centre_mm
    step = 1e-3 * ray / ray[:, axis, None]
    moved = (pencil.second.project(rows.xyz_mm + step) - pencil.second.project(rows.xyz_mm)) / 1e-3
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), rows.px_per_mm, rtol=1e-4)
    np.testing.assert_allclose(moved / rows.px_per_mm[:, None], rows.epipolar, atol=1e-3)
    up_mm, across_mm = np.array([[0.0, 0, 1e-3], [1e-3, 0, 0]])
    for camera, image in (
        (pencil.first, rows.upright_first),
        (pencil.second, rows.upright_second),
    ):
        up = camera.project(rows.xyz_mm + up_mm) - camera.project(rows.xyz_mm)
        np.testing.assert_allclose(up / 1e-3, image, atol=1e-3)
        level = camera.project(rows.xyz_mm + across_mm) - camera.project(rows.xyz_mm)
        if camera is pencil.first:
            first = level
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", rows.level, first) / 1e-3, level / 1e-3, atol=1e-3
    )


def test_nothing_meets_nothing(box_scene):
    first, second = box_scene.rig.cameras
    pencil = Pencil.of(first, second)
    edges = find_edges(box_scene.images["left"])
    none = find_edges(np.full((256, 320), 50, np.uint8))
    for pair in ((edges, none), (none, edges), (none, none)):
        candidates = find_candidates(pencil, *pair, box_scene.rig.volume_mm)
        assert len(candidates) == 0
        assert candidates.level.shape == (0, 2, 2)
        assert len(candidates.select([])) == 0
