"""Elements weighted per point: what repeats is told apart by those that see what does not."""

from __future__ import annotations

import numpy as np
import pytest

from closerange.features.edges import find_edges
from closerange.matching import element_weights
from closerange.matching.candidates import find_candidates, sweep_axis
from closerange.matching.depth_table import DepthTable, Line, Square, Strip
from closerange.matching.element_weights import SQUARES, STRIPS, best_rows, support
from closerange.matching.pencil import Pencil
from closerange.matching.search import between_planes
from closerange.verification.scenes import looking_at_origin

SIZE = (320, 260)
VOLUME = between_planes(-60.0, 60.0)


def _pencil():
    return Pencil.of(
        *(
            looking_at_origin(
                name, angle_rad=angle, distance_mm=600.0, focal_px=1000.0, size_px=SIZE
            )
            for name, angle in (("left", -0.2), ("right", 0.2))
        )
    )


def _painted(camera, brightness):
    """Return the image of a scene: the brightness of where the ray of a pixel meets a height."""
    column, row = np.meshgrid(np.arange(SIZE[0] * 3), np.arange(SIZE[1] * 3))
    xy = np.column_stack([column.ravel(), row.ravel()]) / 3 - 1 / 3
    grey = brightness(camera, xy).reshape(SIZE[1], 3, SIZE[0], 3).mean(axis=(1, 3))
    return np.rint(grey).astype(np.uint8)


def _on_plane(camera, xy, height_mm):
    ray = camera.directions(xy)
    way = (height_mm - camera.centre_mm[2]) / ray[:, 2]
    return (camera.centre_mm + way[:, None] * ray)[:, :2]


def _stripes(height_mm):
    """Upright stripes every 9 mm, and a square 30 mm away that is there once, at one height."""

    def brightness(camera, xy):
        x, y = _on_plane(camera, xy, height_mm).T
        stripe = (np.mod(x, 9.0) < 4.0) & (np.abs(y) < 22.0) & (np.abs(x) < 40.0)
        mark = (np.abs(x - 3.0) < 9.0) & (np.abs(y - 32.0) < 5.0)
        return np.where(stripe | mark, 200.0, 40.0)

    return brightness


def _matched(pencil, brightness):
    edges = [find_edges(_painted(c, brightness)) for c in (pencil.first, pencil.second)]
    candidates = find_candidates(pencil, *edges, VOLUME)
    axis = sweep_axis(pencil)
    table = DepthTable.of(
        Line.of(edges[0].after),
        candidates,
        np.zeros(len(candidates)),
        axis,
        float(pencil.first.centre_mm[axis]),
    )
    return edges[0], candidates, table


def _right(candidates, cost, height_mm):
    """Return the share right, of points that have a right candidate and others."""
    off = np.abs(candidates.xyz_mm[:, 2] - height_mm) * candidates.px_per_mm
    count = int(candidates.point.max()) + 1
    good = np.bincount(candidates.point[off < 1.0], minlength=count)
    every = np.bincount(candidates.point, minlength=count)
    best = best_rows(cost, candidates.point)
    asked = np.flatnonzero((good > 0) & (good < every))
    return np.isin(candidates.point[best[off[best] < 1.0]], asked).sum() / len(asked), len(asked)


def test_repeated_stripes_are_told_apart_by_the_elements_that_see_their_mark():
    edges, candidates, table = _matched(_pencil(), _stripes(10.0))
    share, asked = _right(candidates, support(edges, candidates, table), 10.0)
    small = Square.of(table.line, edges.xy_px, SQUARES[0] * SIZE[0])
    alone, _ = _right(candidates, table.means(candidates, [small])[0], 10.0)
    assert asked > 500
    assert alone < 0.3  # measured 0.24: a small square sees stripes only
    assert share > alone + 0.15  # measured 0.48; 0.50 with the largest square alone


def test_the_weights_are_the_squared_margins(monkeypatch):
    edges, candidates, table = _matched(_pencil(), _stripes(10.0))
    monkeypatch.setattr(element_weights, "SLANT_PRICE", np.inf)
    found = support(edges, candidates, table)
    elements = [Square.of(table.line, edges.xy_px, share * SIZE[0]) for share in SQUARES]
    elements += [Strip.of(table.line, round(share * SIZE[0])) for share in STRIPS]
    costs = np.array(table.means(candidates, elements))
    height, scale = candidates.xyz_mm[:, table.axis], candidates.px_per_mm
    for point in np.unique(candidates.point)[::25]:
        rows = np.flatnonzero(candidates.point == point)
        weights = []
        for cost in costs[:, rows]:
            best = int(np.argmin(cost))
            apart = np.abs(height[rows] - height[rows][best]) * scale[rows] > 1.5
            weights.append(min((cost[apart] - cost[best]).min(initial=3.0), 3.0) ** 2 + 1e-6)
        if min(weights) > 9.0:
            continue  # no rival
        wanted = np.average(costs[:, rows], axis=0, weights=weights)
        np.testing.assert_allclose(found[rows], wanted, atol=1e-9)


def test_with_one_candidate_squares_and_the_chain_nearby_must_agree(monkeypatch):
    pencil = _pencil()
    monkeypatch.setattr(element_weights, "SLANT_PRICE", np.inf)
    edges, candidates, table = _matched(
        pencil, lambda camera, xy: np.where(_on_plane(camera, xy, 0.0)[:, 0] > 0.0, 200.0, 40.0)
    )
    assert (np.bincount(candidates.point) <= 1).all()
    table = DepthTable.of(
        table.line,
        candidates,
        np.random.default_rng(0).uniform(0.0, 2.0, len(candidates)),
        table.axis,
        table.origin_mm,
    )
    found = support(edges, candidates, table)
    elements = [Square.of(table.line, edges.xy_px, share * SIZE[0]) for share in SQUARES]
    elements += [Strip.of(table.line, round(share * SIZE[0])) for share in STRIPS]
    each = np.array(table.means(candidates, elements))
    count = len(SQUARES)
    around = 2 / 3 * each[:count].mean(axis=0) + 1 / 3 * each[count:].mean(axis=0)
    np.testing.assert_allclose(found, np.maximum(around, each[:-1].mean(axis=0)))
    assert np.ptp(found) > 0.1


@pytest.mark.parametrize("power", [1, 4])  # measured 0.484 and 0.511 against 0.483
def test_the_power_of_the_margins_hardly_matters(monkeypatch, power):
    edges, candidates, table = _matched(_pencil(), _stripes(10.0))
    usual, _ = _right(candidates, support(edges, candidates, table), 10.0)
    monkeypatch.setattr(element_weights, "POWER", power)
    other, _ = _right(candidates, support(edges, candidates, table), 10.0)
    assert abs(other - usual) < 0.05
