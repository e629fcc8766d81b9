"""Repeats whose true partner is hidden: a plane with stripes, seen by two parallel cameras.

The true partner of an edge lies 120 px away and the next repeat 48 px from it, which would be a
height of 286 mm or of -667 mm above the plane.
"""

from __future__ import annotations

import numpy as np
import pytest

from closerange.features.edges import find_edges
from closerange.matching import repeats as repeats_module
from closerange.matching.candidates import find_candidates
from closerange.matching.pencil import Pencil
from closerange.matching.repeats import hidden_repeats

PERIOD_MM = 40.0
NEXT_MM = 1000.0 - 1000.0 * 120 / 168
ROWS = slice(180, 330)
BRIGHT = (200.0,)


def volume(top_mm=400.0):
    return np.array([[-np.inf, -np.inf, -50.0], [np.inf, np.inf, top_mm]])


def stripes(camera, bright):
    """Render stripes that run along y on the plane z = 0, with edges of 0.8 px blur."""
    width, height = camera.size_px
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    direction = camera.directions(np.column_stack([x.ravel(), y.ravel()]).astype(float))
    across = camera.centre_mm[0] - camera.centre_mm[2] * direction[:, 0] / direction[:, 2]
    phase = across / PERIOD_MM
    place = np.abs(phase % 1.0 - 0.5) - 0.25  # 0 at an edge, in periods
    share = 0.5 + 0.5 * np.tanh(place * PERIOD_MM * 1.2 / 0.8)
    level = np.array(bright)[np.rint(phase).astype(int) % len(bright)]
    return (40.0 + (level - 40.0) * share).reshape(height, width).astype(np.float32)


def cover(grey, x):
    """Put a dull thing before one edge, with a jagged outline: no piece of it is like a stripe."""
    rows = np.arange(ROWS.start, ROWS.stop)
    half = 13.0 + 0.5 * np.abs(rows % 20 - 10)
    aside = np.abs(np.arange(grey.shape[1]) - x)
    share = np.clip(half[:, None] - aside + 0.5, 0.0, 1.0)
    grey[ROWS] += share * (90.0 - grey[ROWS])


class Scene:
    """Stripes of which parts are covered; `matches` chooses partners by their height."""

    def __init__(self, cameras, covered=((), ()), bright=BRIGHT):
        self.pencil = Pencil.of(*cameras)
        self.greys = tuple(stripes(camera, bright) for camera in cameras)
        for grey, places in zip(self.greys, covered, strict=True):
            for x in places:
                cover(grey, x)
        self.edges = tuple(find_edges(grey) for grey in self.greys)
        self.clear = tuple(np.ones(len(edges), dtype=bool) for edges in self.edges)

    def matches(self, height_mm, columns=(0, 640), rows=slice(0, 512)):
        """Return what lies at a height, of upright edges in some part of the view."""
        found = find_candidates(self.pencil, *self.edges, volume(900.0))
        x, y = self.edges[0].xy_px[found.point].T
        near = (np.abs(found.xyz_mm[:, 2] - height_mm) < 3) & (x >= columns[0]) & (x < columns[1])
        near &= (y >= rows.start) & (y < rows.stop)
        near &= np.abs(self.edges[0].normal[found.point, 0]) > 0.99
        return found.select(np.flatnonzero(near))

    def wrong(self, first):
        """Return the pairs of the edge at a column with the next repeat, where it is covered."""
        rows = slice(ROWS.start + 4, ROWS.stop - 4)
        return self.matches(NEXT_MM, (first - 4, first + 5), rows)

    def doubted(self, chosen, clear=None, volume_mm=None):
        """Return the share of the chosen that are marked; no others may be."""
        relied = np.zeros(len(self.edges[0]), dtype=bool)
        relied[chosen.point] = True
        box = volume() if volume_mm is None else volume_mm
        clear = self.clear if clear is None else clear
        marked = hidden_repeats(self.pencil, self.edges, self.greys, chosen, relied, clear, box)
        assert marked.shape == relied.shape
        assert not marked[~relied].any()
        return marked[chosen.point].mean()


@pytest.fixture(scope="module")
def cameras(setups):
    return setups.cameras("parallel")


@pytest.fixture(scope="module")
def rising(cameras):
    """Return where one rising edge lies in the first view, and its partner in the second."""
    edges = find_edges(stripes(cameras[0], BRIGHT))
    middle = np.abs(edges.xy_px[:, 1] - 255) < 0.6
    places = np.unique(np.rint(edges.xy_px[middle & (edges.normal[:, 0] > 0), 0]))
    first = places[np.argmin(np.abs(places - 330.0))]
    on_plane = cameras[0].directions(np.array([[first, 255.0]]))[0]
    centre = cameras[0].centre_mm
    xyz = centre - centre[2] / on_plane[2] * on_plane
    return first, float(np.rint(cameras[1].project(xyz[None])[0, 0]))


@pytest.fixture(scope="module")
def left_over(cameras, rising):
    """Make a scene with a stripe whose partner is covered beside one that lacks its own."""
    first, second = rising
    # the wrong partner, of a height of 286 mm, lies one repeat further from the first camera's
    further = np.sign(second - first) * 48
    return Scene(cameras, ((first + further,), (second,))), first


def test_all_repeats_visible_leave_no_doubt(cameras):
    scene = Scene(cameras)
    chosen = scene.matches(0.0)
    assert len(chosen) > 5000
    assert scene.doubted(chosen) == 0.0


def test_leftover_stripes_that_fit_each_other_at_a_wrong_height_are_marked(left_over):
    scene, first = left_over
    wrong = scene.wrong(first)
    assert len(wrong) > 100
    assert scene.doubted(wrong) == 1.0


def test_the_others_of_that_scene_stay_unmarked(left_over):
    scene, _ = left_over
    right = scene.matches(0.0)
    assert len(right) > 4000
    assert scene.doubted(right) < 0.05


def test_a_repeat_that_was_compared_and_lost_clearly_is_no_reason_for_doubt(cameras, rising):
    """Nothing is covered: the same wrong pairs were chosen against rivals in both views."""
    scene = Scene(cameras)
    wrong = scene.matches(NEXT_MM, (rising[0] - 4, rising[0] + 5))
    assert len(wrong) > 300
    assert scene.doubted(wrong) == 0.0
    by_chance = tuple(np.zeros_like(clear) for clear in scene.clear)
    assert scene.doubted(wrong, clear=by_chance) == 1.0
    for one in (0, 1):  # either view's comparison is enough
        clear = tuple(scene.clear[k] if k == one else by_chance[k] for k in (0, 1))
        assert scene.doubted(wrong, clear=clear) == 0.0


@pytest.mark.parametrize(("lowest_mm", "marked"), [(-50.0, 1.0), (60.0, 0.0)])
def test_only_what_lies_in_the_volume_can_be_meant(left_over, lowest_mm, marked):
    """The true height is 0; the repeat on the other side would be at 444 mm."""
    scene, first = left_over
    wrong = scene.wrong(first)
    box = volume()
    box[0, 2] = lowest_mm
    assert scene.doubted(wrong, volume_mm=box) == marked


def test_edges_of_other_grey_are_no_repeats(cameras, rising):
    """Every second stripe is darker: the next alike is two away, outside of the volume."""
    first, second = rising
    further = np.sign(second - first) * 48
    scene = Scene(cameras, ((first + further,), (second,)), bright=(220.0, 110.0))
    wrong = scene.wrong(first)
    assert len(wrong) > 100
    assert scene.doubted(wrong) == 0.0


def test_pieces_of_the_work_make_no_difference(left_over, monkeypatch):
    scene, first = left_over
    chosen = scene.wrong(first)
    relied = np.zeros(len(scene.edges[0]), dtype=bool)
    relied[chosen.point] = True
    ask = (scene.pencil, scene.edges, scene.greys, chosen, relied, scene.clear, volume())
    whole = hidden_repeats(*ask)
    assert whole.any()
    monkeypatch.setattr(repeats_module, "POINTS_AT_ONCE", 77)
    np.testing.assert_array_equal(hidden_repeats(*ask), whole)


def test_a_pair_of_chains_is_judged_as_a_whole(left_over):
    """Where the neighbours are seen along a part only, the rest goes with it."""
    scene, first = left_over
    wrong = scene.wrong(first)
    # all else in the upper part is covered, in both views
    point = scene.edges[0].xy_px[wrong.point]
    greys = [grey.copy() for grey in scene.greys]
    part = slice(ROWS.start, ROWS.start + 90)
    for grey, at in zip(greys, (point, wrong.xy_px), strict=True):
        beside = np.abs(np.arange(640) - np.median(at[:, 0])) > 11
        grey[part, beside] = 120.0
    other = object.__new__(Scene)
    other.pencil, other.greys = scene.pencil, tuple(greys)
    other.edges = tuple(find_edges(grey) for grey in greys)
    other.clear = tuple(np.ones(len(edges), dtype=bool) for edges in other.edges)
    rest = other.wrong(first)
    assert len(rest) > 100
    assert other.doubted(rest) == 1.0


def test_nothing_to_judge_gives_no_marks(left_over):
    scene, _ = left_over
    none = scene.matches(0.0).select([])
    relied = np.ones(len(scene.edges[0]), dtype=bool)
    for chosen, trust in ((none, relied), (scene.matches(0.0), ~relied)):
        marked = hidden_repeats(
            scene.pencil, scene.edges, scene.greys, chosen, trust, scene.clear, volume()
        )
        assert not marked.any()
