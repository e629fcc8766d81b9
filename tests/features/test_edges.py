"""Edge points: where they lie, what is stated of them, how they are linked."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from closerange.errors import InputError
from closerange.features.edge_chains import (
    AHEAD,
    REACH_PX,
    SAME_WAY,
    chain_line,
    chain_numbers,
    chain_places,
    chain_window,
    link_edges,
)
from closerange.features.edges import find_edges
from closerange.features.grey_noise import noise_curve


def step(angle_rad, offset_px, *, noise=0.0, seed=0, size=96, low=60.0, high=180.0, blur=0.8):
    """Draw a straight edge by formula: the integral of a Gaussian across it."""
    from scipy.special import erf  # noqa: PLC0415

    y, x = np.mgrid[0:size, 0:size] - (size - 1) / 2
    across = x * np.cos(angle_rad) + y * np.sin(angle_rad) - offset_px
    # a square pixel widens the blur by its own variance of 1/12
    width = np.sqrt(2 * (blur**2 + 1 / 12))
    grey = low + (high - low) * (0.5 + 0.5 * erf(across / width))
    return grey + np.random.default_rng(seed).normal(0, noise, grey.shape)


def across(edges, angle_rad, offset_px, size=96):
    xy = edges.xy_px - (size - 1) / 2
    return xy @ [np.cos(angle_rad), np.sin(angle_rad)] - offset_px


def as_image(grey):
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def test_edges_lie_where_they_were_drawn_at_any_angle_and_phase():
    """The largest systematic error over the pixel grid is 0.02 px."""
    worst = 0.0
    for i, angle in enumerate(np.linspace(0.0, 2 * np.pi, 16, endpoint=False) + 0.07):
        edges = find_edges(as_image(step(angle, 0.9 * i / 16 - 0.4)))
        error = across(edges, angle, 0.9 * i / 16 - 0.4)
        assert len(edges) > 80
        assert abs(error.mean()) < 0.01
        worst = max(worst, np.abs(error).max())
        towards = edges.normal @ [np.cos(angle), np.sin(angle)]
        assert towards.min() > 0.999, "the normal points to the brighter side"
    assert worst < 0.03


def test_stated_noise_is_the_scatter():
    """Over edges at twelve angles, noise 3 grey values of a step of 120."""
    stated, seen = [], []
    for i, angle in enumerate(np.linspace(0.0, np.pi, 12, endpoint=False) + 0.1):
        edges = find_edges(as_image(step(angle, 0.3, noise=3.0, seed=i)))
        inner = np.abs(edges.xy_px - 47.5).max(axis=1) < 40
        near = inner & (np.abs(across(edges, angle, 0.3)) < 1.0)
        stated.append(np.mean(edges.noise_px[near] ** 2))
        seen.append(np.mean(across(edges, angle, 0.3)[near] ** 2))
    ratio = np.sqrt(np.mean(seen) / np.mean(stated))
    assert 0.8 < ratio < 1.25
    assert 0.02 < np.sqrt(np.mean(seen)) < 0.08


@pytest.mark.parametrize("scale", [1, 250])
def test_pure_noise_and_plain_images_have_no_edges(scale):
    rng = np.random.default_rng(2)
    kind = np.uint8 if scale == 1 else np.uint16
    noise = np.clip(rng.normal(100, 4, (200, 260)).round(), 0, 255) * scale
    assert len(find_edges(noise.astype(kind))) == 0
    plain = find_edges(np.full((50, 60), 7 * scale, kind))
    assert len(plain) == 0
    assert plain.xy_px.shape == (0, 2)
    assert plain.tangent.shape == (0, 2)
    assert len(plain.select([])) == 0


def test_a_spot_is_no_edge_and_the_shortest_chain_is_kept():
    spot = np.full((40, 40), 20, np.uint8)
    spot[20, 20] = 200
    few = find_edges(spot)
    assert len(few) < 12, "the ring around it at most"
    bar = np.full((40, 40), 20, np.uint8)
    bar[10:18, 8:30] = 200
    chain = chain_numbers(find_edges(bar).after)
    assert np.bincount(chain).min() >= 6


def test_chains_run_round_a_disc_with_the_brighter_side_on_one_hand():
    y, x = np.mgrid[0:80, 0:80]
    disc = 40 + 150 * np.clip(20.5 - np.hypot(x - 39.3, y - 40.6), 0, 1)
    edges = find_edges(as_image(cv2.GaussianBlur(disc, (0, 0), 0.7)))
    radius = np.hypot(*(edges.xy_px - [39.3, 40.6]).T)
    assert np.abs(radius - 20.0).max() < 0.2
    linked = np.flatnonzero(edges.after >= 0)
    assert linked.size > 0.9 * len(edges)
    assert (edges.before[edges.after[linked]] == linked).all()
    way = edges.xy_px[edges.after[linked]] - edges.xy_px[linked]
    assert np.einsum("ni,ni->n", way, edges.tangent[linked]).min() > 0
    assert len(np.unique(chain_numbers(edges.after))) <= 3


def test_places_windows_and_links_by_hand():
    after = np.array([1, 2, -1, 4, 3, -1])  # a chain of three, a ring of two, a single point
    chain, place = chain_places(after)
    assert chain[:3].tolist() == [chain[0]] * 3
    assert place[:3].tolist() == [0, 1, 2]
    assert sorted(place[3:5]) == [0, 1]
    assert len({chain[0], chain[3], chain[5]}) == 3
    before = np.array([-1, 0, 1, 4, 3, -1])
    window = chain_window(after, before, 2)
    assert window[0].tolist() == [-1, -1, 0, 1, 2]
    assert window[2].tolist() == [0, 1, 2, -1, -1]
    assert window[5].tolist() == [-1, -1, 5, -1, -1]
    row = np.column_stack([np.arange(10.0) + 5, np.full(10, 8.0)])
    up = np.tile([0.0, -1.0], (10, 1))
    after, before = link_edges(row, up, (30, 20))
    assert after.tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9, -1]
    assert before.tolist() == [-1, 0, 1, 2, 3, 4, 5, 6, 7, 8]
    gone = link_edges(np.zeros((0, 2)), np.zeros((0, 2)), (30, 20))
    assert [len(part) for part in gone] == [0, 0]


def test_links_are_the_cheapest_of_all_pairs_tried_one_by_one():
    """Scattered points with random normals, in cells of a pixel, against the rule itself."""
    rng = np.random.default_rng(8)
    xy = rng.permutation(np.argwhere(np.ones((16, 16))))[:90] + rng.uniform(-0.4, 0.4, (90, 2))
    turn = rng.uniform(-0.6, 0.6, 90)
    normal = np.column_stack([np.sin(turn), -np.cos(turn)])
    tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
    best = np.full((2, 90), -1)
    for i in range(90):
        least = [np.inf, np.inf]
        for j in range(90):
            step = xy[j] - xy[i]
            near = (np.abs(np.rint(xy[j]) - np.rint(xy[i])) <= REACH_PX).all()
            if i == j or not near or normal[i] @ normal[j] <= SAME_WAY:
                continue
            distance = np.linalg.norm(step)
            ahead = step @ tangent[i] / distance
            cost = distance + abs(step @ normal[i]) + abs(step @ normal[j])
            side = int(ahead < 0)
            if abs(ahead) > AHEAD and cost < least[side]:
                least[side], best[side, i] = cost, j
    wanted = [j if j >= 0 and best[1, j] == i else -1 for i, j in enumerate(best[0])]
    after, before = link_edges(xy, normal, (16, 16))
    assert after.tolist() == wanted
    assert (after >= 0).sum() > 20
    linked = np.flatnonzero(after >= 0)
    np.testing.assert_array_equal(before[after[linked]], linked)


def test_a_line_of_chains_by_hand():
    after = np.array([4, -1, 5, 1, 3, 2, -1])  # 0 4 3 1, closed 2 5, single 6
    order, end = chain_line(after)
    assert order.tolist() == [0, 4, 3, 1, 6, 2, 5]
    assert end.tolist() == [4, 5, 7]
    assert [part.tolist() for part in chain_line(np.zeros(0, np.int64))] == [[], []]


def test_the_noise_curve_follows_shot_noise():
    rng = np.random.default_rng(4)
    level = np.tile(np.linspace(20, 220, 500), (400, 1))
    true = np.sqrt(1.0 + 0.1 * level)
    grey = np.rint(level + true * rng.normal(size=level.shape)).astype(np.float32)
    curve = noise_curve(grey, cv2.blur(grey, (5, 5)))
    stated = curve.at(np.array([40.0, 120.0, 200.0]))
    wanted = np.sqrt(1.0 + 0.1 * np.array([40.0, 120.0, 200.0]) + 1 / 12)
    np.testing.assert_allclose(stated, wanted, rtol=0.08)
    flat = noise_curve(np.full((90, 90), 9, np.float32), np.full((90, 90), 9, np.float32))
    assert flat.noise.min() == pytest.approx(1 / np.sqrt(12))


def test_a_wide_edge_states_a_larger_model_error_than_a_sharp_one():
    y, x = np.mgrid[0:80, 0:160]
    grey = np.where(x < 80, 50.0, 180.0) + np.where(y < 0, 0, 0)
    sharp = cv2.GaussianBlur(grey, (0, 0), 0.7)
    wide = 50 + 130 * np.clip((x - 120) / 8 + 0.5, 0, 1)
    both = np.where(y < 40, sharp, wide)
    edges = find_edges(as_image(both))
    upper, lower = edges.xy_px[:, 1] < 30, edges.xy_px[:, 1] > 50
    assert np.median(edges.model_px[lower]) > 2 * np.median(edges.model_px[upper])
    assert np.median(edges.width_px2[lower]) > 2 * np.median(edges.width_px2[upper])


@pytest.mark.parametrize("shape", [(8, 40), (40, 8), (20, 20, 3), (0, 0)])
def test_images_that_are_none_are_refused(shape):
    with pytest.raises(InputError, match="edges need"):
        find_edges(np.zeros(shape, np.uint8))
