import numpy as np
import pytest

from closerange.errors import InputError
from closerange.flags import Flag
from closerange.matching.element_choice import (
    ELEMENTS,
    SIZES_PX,
    THICKNESS_PX,
    UNLIKE,
    distinctness,
    edge_directions,
    match_with_best_element,
)
from closerange.matching.literal import LiteralMatcher
from closerange.matching.literal_band import Bands
from closerange.matching.literal_element import footprint
from closerange.matching.literal_scan import choose_places
from closerange.matching.search import between_planes, upper_plane_mapping
from closerange.verification.scenes import looking_at_origin

SIZE = (320, 260)
VOLUME = between_planes(-25.0, 25.0)


def _pair():
    return tuple(
        looking_at_origin(name, angle_rad=angle, distance_mm=600.0, focal_px=1000.0, size_px=SIZE)
        for name, angle in (("left", -0.2), ("right", 0.2))
    )


def _seen(cameras, first, height_mm):
    """What camera 2 sees of marks of image 1 that lie at a height, widened to be without gaps."""
    row, column = np.nonzero(first)
    there = upper_plane_mapping(*cameras, np.column_stack([column, row]), height_mm).xy_px
    x, y = np.rint(there).astype(int).T
    second = np.zeros_like(first)
    inside = (x >= 1) & (y >= 1) & (x < SIZE[0] - 1) & (y < SIZE[1] - 1)
    for across in (0, 1):
        second[y[inside], x[inside] + across] = True
    return second


def _stripes():
    """Upright stripes every 9 px and one dash that tells them apart, 14 px from the seed."""
    first = np.zeros(SIZE[::-1], np.bool_)
    for start in range(76, 250, 9):
        first[60:200, start : start + 2] = True
    first[143:146, 150:164] = True
    return first


def _bands(length):
    return Bands(
        np.arange(length, dtype=np.int32)[None],
        np.zeros((1, length), np.int32),
        np.ones((1, length), np.bool_),
        np.zeros(1, np.int64),
    )


def test_there_are_six_sizes_and_four_shapes():
    assert len(SIZES_PX) == 6
    assert len(set(ELEMENTS)) == 24


def test_distinctness_is_the_gap_to_the_best_place_elsewhere():
    hits = np.array([[0, 3, 9, 20, 19, 18, 12, 5]], np.uint16)
    places = _bands(8)
    found = distinctness(hits, places, choose_places(hits, places), np.array([25]))
    # 19 and 18 are within 2 px of the best and belong to it; 12 is the next
    assert found[0] == pytest.approx((20 - 12) / np.sqrt(THICKNESS_PX * 25 + (UNLIKE * 25) ** 2))
    lonely = np.array([[0, 0, 0, 20, 0, 0, 0, 0]], np.uint16)
    assert distinctness(lonely, places, choose_places(lonely, places), np.array([25]))[0] > found[0]
    twice = np.array([[20, 0, 0, 0, 0, 0, 0, 20]], np.uint16)
    assert distinctness(twice, places, choose_places(twice, places), np.array([25]))[0] == 0
    nothing = np.zeros((1, 8), np.uint16)
    assert distinctness(nothing, places, choose_places(nothing, places), np.array([0]))[0] == 0


@pytest.mark.parametrize("turn", range(16))
def test_directions_of_edges(turn):
    mask = np.zeros((60, 60), np.bool_)
    angle = np.pi * turn / 16
    y, x = np.mgrid[-30:30, -30:30]
    mask[np.abs(x * np.sin(angle) - y * np.cos(angle)) <= 1.2] = True
    found = int(edge_directions(mask, np.array([[30, 30]]))[0])
    assert min((found - turn) % 16, (turn - found) % 16) <= 1  # 3 px thick in a window of 9


def test_directions_at_the_border_and_without_edges():
    mask = np.zeros((20, 30), np.bool_)
    mask[0] = True
    assert edge_directions(mask, np.array([[0, 0], [29, 0], [15, 19]])).tolist() == [0, 0, 0]


def test_repeated_stripes_are_told_apart_by_an_element_that_reaches_their_mark():
    cameras, first = _pair(), _stripes()
    masks = (first, _seen(cameras, first, 10.0))
    seeds = np.array([[148.0, 130.0], [148.0, 128.0], [149.0, 132.0]])
    truth = upper_plane_mapping(*cameras, seeds, 10.0).xy_px
    small = LiteralMatcher(cameras, masks, VOLUME).match(seeds, footprint(9))
    assert (small.flags & Flag.ambiguous).all()
    chosen = match_with_best_element(cameras, masks, seeds, VOLUME)
    assert (np.linalg.norm(chosen.matches.xy_px - truth, axis=1) < 1.5).all()
    assert all(ELEMENTS[index][1] >= 29 for index in chosen.element)
    assert not (chosen.matches.flags & (Flag.ambiguous | Flag.inconsistent)).any()
    for row, index in enumerate(chosen.element):
        assert chosen.returns[row, index]
        value = chosen.distinctness[row] * chosen.support[row]
        assert value[index] == value[chosen.returns[row] & chosen.centred[row]].max()
        assert chosen.xy_px[row, index].tolist() == chosen.matches.xy_px[row].tolist()
        assert chosen.distinctness[row, 0] == 0 < chosen.distinctness[row, index]


def test_an_element_that_reaches_over_other_depths_is_not_chosen():
    """A small mark on a low plane amid a dense pattern of a high one, which outvotes it."""
    cameras = _pair()
    rng = np.random.default_rng(0)
    high = rng.random(SIZE[::-1]) < 0.06
    high[100:150, 130:180] = False
    low = np.zeros_like(high)
    low[118:133, 148:163] = rng.random((15, 15)) < 0.5
    second = _seen(cameras, high, 20.0) | _seen(cameras, low, -20.0)
    seed = np.array([[155.0, 125.0]])
    truth = upper_plane_mapping(*cameras, seed, -20.0).xy_px
    masks = (high | low, second)
    large = LiteralMatcher(cameras, masks, VOLUME).match(seed, footprint(121))
    assert np.linalg.norm(large.xy_px - truth) > 3
    kinds = (("square", 15), ("square", 121))
    chosen = match_with_best_element(cameras, masks, seed, VOLUME, elements=kinds)
    assert chosen.element.tolist() == [0]
    assert np.linalg.norm(chosen.matches.xy_px - truth) < 1.5


def test_nothing_is_made_up():
    cameras, first = _pair(), _stripes()
    nothing = np.zeros_like(first)
    seeds = [[150.0, 130.0], [-3.0, 10.0], [np.nan, 1.0], [np.inf, 2.0]]
    for masks in ((nothing, first), (first, nothing)):
        found = match_with_best_element(cameras, masks, seeds, VOLUME)
        assert found.element.tolist() == [-1] * 4
        assert np.isnan(found.matches.xy_px).all()
        assert found.matches.flags[0] == Flag.no_edge
        assert found.matches.flags[1] & Flag.outside_image
        assert found.matches.flags[2:].tolist() == [Flag.not_found] * 2
        assert not found.distinctness.any()
    assert len(match_with_best_element(cameras, (first, first), [], VOLUME)) == 0


def test_a_match_that_does_not_return_is_flagged():
    cameras = _pair()
    seed = np.array([[150.0, 130.0]])
    rng = np.random.default_rng(2)
    first = np.zeros(SIZE[::-1], np.bool_)
    whole = rng.random((15, 15)) < 0.4
    # around the seed a part of a pattern that is whole elsewhere in view 1, on the same plane
    # of sight: view 2 shows the whole one, to which the part fits and which fits the whole
    first[123:138, 143:158] = whole & (rng.random((15, 15)) < 0.5)
    first[130, 150] = True
    first[123:138, 163:178] = whole
    second = np.zeros_like(first)
    there = upper_plane_mapping(*cameras, [[170.0, 130.0]], 0.0).xy_px[0]
    column, row = np.rint(there).astype(int)
    second[row - 7 : row + 8, column - 7 : column + 8] = whole
    kinds = (("square", 15), ("disc", 15))
    found = match_with_best_element(cameras, (first, second), seed, VOLUME, elements=kinds)
    assert np.isfinite(found.matches.xy_px).all()
    assert not found.returns.any()
    assert found.matches.flags[0] & Flag.inconsistent


def test_progress_and_bad_elements():
    cameras, first = _pair(), _stripes()
    told = []
    kinds = (("disc", 9), ("strip", 15))
    match_with_best_element(
        cameras,
        (first, first),
        [[150.0, 130.0]],
        VOLUME,
        elements=kinds,
        progress=lambda done, total: told.append((done, total)),
    )
    assert told == [(1, 2), (2, 2)]
    with pytest.raises(InputError, match="no element"):
        match_with_best_element(cameras, (first, first), [[150.0, 130.0]], VOLUME, elements=())
    for kind in (("disc", 8), ("strip", 1), ("star", 9)):
        with pytest.raises(InputError):
            match_with_best_element(
                cameras, (first, first), [[150.0, 130.0]], VOLUME, elements=(kind,)
            )
