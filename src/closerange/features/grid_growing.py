"""Growing integer coordinates over candidates that stand in a lattice.

A disc's image ellipse gives the affine map of its surroundings but for a rotation: it turns
the picture around the disc back into millimetres on the plate. The neighbours of a disc are
then known by distance and right angle, whatever the tilt. From such a seed the lattice grows
breadth first, each disc predicted from the steps at its neighbour, so lens distortion and
perspective only matter over one pitch.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from closerange.features.pattern import DiscGrid
from closerange.geometry.arrays import FloatArray, IntArray

SEED_TOLERANCE = 0.25
"""Relative error of a neighbour seen through a seed's ellipse: 10 % change of scale over one
pitch at 60 degrees of tilt, 10 % from the ellipse of a disc of few pixels, and room."""

GROW_TOLERANCE = 0.3
"""Largest error of a predicted neighbour in pitches: well below 0.5, where the next place
begins, and above the 10 to 15 % that steep perspective and a wide lens change in one pitch."""

NEIGHBOURS = 60
"""Candidates looked at around a seed; a lattice has 8, the rest is room for clutter."""

Node: TypeAlias = tuple[int, int]
Nodes: TypeAlias = dict[Node, int]
"""Place in the lattice -> candidate; i counts along columns, j along rows."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Discs found in an image, in the form in which labelling needs them.

    Attributes
    ----------
    xy_px : ndarray, shape (M, 2)
        Centres, px.
    radius_px : ndarray, shape (M,)
        Geometric mean of the semi-axes, px.
    whitener : ndarray, shape (M, 2, 2)
        Turns an image offset at the disc into disc radii on the plate, but for a rotation.
    tree : cKDTree
        Of the centres.
    """

    xy_px: FloatArray
    radius_px: FloatArray
    whitener: FloatArray
    tree: Any

    @classmethod
    def of(cls, xy_px: FloatArray, ellipse: FloatArray) -> Candidates:
        """Prepare M discs from centres (M, 2) and ellipses (M, 3)."""
        a, b, angle = ellipse.T
        cosine, sine = np.cos(angle), np.sin(angle)
        axes = np.stack([np.stack([cosine, -sine], -1), np.stack([sine, cosine], -1)], -2)
        inverse = axes * np.stack([1 / a, 1 / b], -1)[:, None, :]
        return cls(xy_px, np.sqrt(a * b), inverse @ axes.transpose(0, 2, 1), cKDTree(xy_px))

    def __len__(self) -> int:
        return len(self.xy_px)

    def only(self, rows: IntArray) -> Candidates:
        """Keep some of the discs."""
        xy_px = self.xy_px[rows]
        return Candidates(xy_px, self.radius_px[rows], self.whitener[rows], cKDTree(xy_px))


@dataclass(frozen=True, slots=True, eq=False)
class Seed:
    """A candidate and the image steps to its next column and its next row."""

    index: int
    along_columns: FloatArray
    along_rows: FloatArray
    score: float


def seeds(candidates: Candidates, grid: DiscGrid) -> list[Seed]:
    """Find candidates with neighbours where an ordinary disc would have them, best first.

    Parameters
    ----------
    candidates : Candidates
        M discs.
    grid : DiscGrid
        Pitch and diameter.

    Returns
    -------
    list of Seed
        At most one a candidate. The steps form a right-handed pair in the image (x right,
        y down): a mirrored lattice is never seeded.
    """
    found = (_seed(index, candidates, grid) for index in range(len(candidates)))
    return sorted((seed for seed in found if seed), key=lambda seed: (-seed.score, seed.index))


def grow(seed: Seed, candidates: Candidates, grid: DiscGrid) -> Nodes:
    """Grow a lattice from a seed.

    Parameters
    ----------
    seed : Seed
        Where to begin.
    candidates : Candidates
        M discs.
    grid : DiscGrid
        Pitch and diameters.

    Returns
    -------
    dict of (int, int) to int
        Candidate at each place that was reached; (0, 0) is the seed. May hold places outside
        of the target where other things fit.
    """
    nodes: Nodes = {(0, 0): seed.index}
    inherited = {(0, 0): np.stack([seed.along_columns, seed.along_rows])}
    taken = {seed.index}
    low, high = size_limits(grid)
    queue: deque[Node] = deque([(0, 0)])
    while queue:
        node = queue.popleft()
        steps = _steps(node, nodes, inherited[node], candidates.xy_px)
        expected = expected_radius(steps, grid)
        if not expected > 0:
            continue
        for place, offset in _four_neighbours(node):
            if place in nodes:
                continue
            index = _nearest(
                candidates, candidates.xy_px[nodes[node]] + offset @ steps, steps, taken
            )
            if index >= 0 and low < candidates.radius_px[index] / expected < high:
                nodes[place] = index
                inherited[place] = steps
                taken.add(index)
                queue.append(place)
    return nodes


def expected_radius(steps: FloatArray, grid: DiscGrid) -> float:
    """Return the radius in px of an ordinary disc where the lattice has these two steps.

    Parameters
    ----------
    steps : ndarray, shape (2, 2)
        Image steps to the next column and to the next row, px; one step a row.
    grid : DiscGrid
        Pitch and diameter.

    Returns
    -------
    float
        Geometric mean of the expected semi-axes, px; 0 where the steps are not a
        right-handed pair.
    """
    area = steps[0, 0] * steps[1, 1] - steps[0, 1] * steps[1, 0]
    scale = max(float(area), 0.0) / (grid.pitch_mm[0] * grid.pitch_mm[1])
    return float(grid.disc_diameter_mm / 2 * np.sqrt(scale))


def size_limits(grid: DiscGrid) -> tuple[float, float]:
    """Return the smallest and largest radius, relative to an ordinary disc, worth a look.

    A local cell predicts the radius to 20 % or so; what fits less well is sorted out later,
    when more of the lattice is known.
    """
    ratios = grid.diameters_mm / grid.disc_diameter_mm
    return 0.6 * min(1.0, float(ratios.min())), 1.6 * max(1.0, float(ratios.max()))


def lines(candidates: Candidates, pitch_mm: float, grid: DiscGrid) -> list[tuple[int, ...]]:
    """Find straight rows of candidates at the target's pitch, for grids of one row or column.

    Parameters
    ----------
    candidates : Candidates
        M discs.
    pitch_mm : float
        Distance of neighbours, mm.
    grid : DiscGrid
        Diameters.

    Returns
    -------
    list of tuple of int
        Candidates in order along each line; every line once, in one of its two directions.
    """
    found: dict[frozenset[int], tuple[int, ...]] = {}
    for index in range(len(candidates)):
        near, plate_mm = _surroundings(index, candidates, grid, pitch_mm)
        offset = candidates.xy_px[near] - candidates.xy_px[index]
        there_mm = np.einsum("nij,nj->ni", candidates.whitener[near], offset)
        there_mm *= grid.disc_diameter_mm / 2
        # seen from both ends, so that the change of scale between them cancels
        length = np.sqrt(np.linalg.norm(plate_mm, axis=1) * np.linalg.norm(there_mm, axis=1))
        for other in near[np.abs(length / pitch_mm - 1) < SEED_TOLERANCE]:
            line = _line(index, int(other), candidates, size_limits(grid))
            found.setdefault(frozenset(line), line)
    return [found[key] for key in sorted(found, key=sorted)]


def _line(
    first: int, second: int, candidates: Candidates, limits: tuple[float, float]
) -> tuple[int, ...]:
    """Continue two neighbours to a whole line, in both directions."""
    line = deque([first, second])
    for end, before, extend in ((-1, -2, line.append), (0, 1, line.appendleft)):
        while True:
            x = candidates.xy_px
            step = x[line[end]] - x[line[before]]
            across = np.array([-step[1], step[0]])
            taken = set(line)
            index = _nearest(candidates, x[line[end]] + step, np.stack([step, across]), taken)
            size = candidates.radius_px[index] / candidates.radius_px[line[end]]
            if index < 0 or not limits[0] < size < limits[1]:
                break
            extend(index)
    return tuple(line)


def _surroundings(
    index: int, candidates: Candidates, grid: DiscGrid, pitch_mm: float
) -> tuple[IntArray, FloatArray]:
    """Return the candidates around one, and their offsets on the plate in mm."""
    reach_mm = 2.2 * pitch_mm  # to the diagonal neighbour, with the seed's tolerance
    radius_mm = grid.disc_diameter_mm / 2
    whitener = candidates.whitener[index]
    longest = 1 / float(np.linalg.svd(whitener, compute_uv=False)[-1])  # semi-major axis, px
    near = np.array(
        candidates.tree.query_ball_point(candidates.xy_px[index], longest * reach_mm / radius_mm),
        dtype=np.int64,
    )
    near = np.sort(near[near != index])
    plate = (candidates.xy_px[near] - candidates.xy_px[index]) @ whitener.T * radius_mm
    order = np.argsort(np.linalg.norm(plate, axis=1), kind="stable")[:NEIGHBOURS]
    return near[order], plate[order]


def _seed(index: int, candidates: Candidates, grid: DiscGrid) -> Seed | None:
    """Find the pair of neighbours that best explains the surroundings of a candidate."""
    px, py = grid.pitch_mm
    near, plate = _surroundings(index, candidates, grid, max(px, py))
    length = np.linalg.norm(plate, axis=1)
    best: Seed | None = None
    for i in np.flatnonzero(np.abs(length / px - 1) < SEED_TOLERANCE):
        wanted = np.array([-plate[i, 1], plate[i, 0]]) * (py / px)
        error = np.linalg.norm(plate - wanted, axis=1) / py
        j = int(error.argmin())
        if error[j] > SEED_TOLERANCE:
            continue
        score = _score(plate, plate[i], plate[j], min(px, py))
        # exactness only breaks ties between equally complete surroundings
        score -= (abs(length[i] / px - 1) + abs(length[j] / py - 1) + error[j]) / 10
        if best is None or score > best.score:
            x = candidates.xy_px
            best = Seed(index, x[near[i]] - x[index], x[near[j]] - x[index], float(score))
    return best


def _score(plate: FloatArray, u: FloatArray, v: FloatArray, pitch_mm: float) -> float:
    """Count how many of the eight neighbours are where a lattice has them."""
    places = np.array([i * u + j * v for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    distance = np.linalg.norm(plate[None] - places[:, None], axis=2).min(axis=1)
    return float(np.count_nonzero(distance < SEED_TOLERANCE * pitch_mm))


def _four_neighbours(node: Node) -> Iterator[tuple[Node, FloatArray]]:
    for di, dj in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        yield (node[0] + di, node[1] + dj), np.array([di, dj], dtype=np.float64)


def _steps(node: Node, nodes: Nodes, inherited: FloatArray, xy_px: FloatArray) -> FloatArray:
    """Return the two steps at a node: measured where it has neighbours, else inherited."""
    steps = inherited.copy()
    here = xy_px[nodes[node]]
    for axis, (di, dj) in enumerate(((1, 0), (0, 1))):
        after = nodes.get((node[0] + di, node[1] + dj))
        before = nodes.get((node[0] - di, node[1] - dj))
        sides = [xy_px[after] - here] if after is not None else []
        sides += [here - xy_px[before]] if before is not None else []
        if sides:
            steps[axis] = np.mean(sides, axis=0)
    return steps


def _nearest(
    candidates: Candidates, predicted: FloatArray, steps: FloatArray, taken: set[int]
) -> int:
    """Return the free candidate nearest to a predicted place, in pitches; -1 if none is near."""
    reach = GROW_TOLERANCE * float(np.linalg.norm(steps, axis=1).sum())
    inverse = np.linalg.inv(steps)
    best, least = -1, GROW_TOLERANCE
    for index in candidates.tree.query_ball_point(predicted, reach):
        if index in taken:
            continue
        error = float(np.linalg.norm((candidates.xy_px[index] - predicted) @ inverse))
        if error < least:
            best, least = int(index), error
    return best
