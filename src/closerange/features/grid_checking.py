"""Checking a grown lattice: place and size of each disc by its neighbours.

The neighbours up to two places away fix a local homography, which holds perspective exactly
and lens distortion to the third order of the pitch. It predicts place and size of the disc in
their middle without using that disc.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from closerange.features.grid_growing import Candidates, Node, Nodes, expected_radius
from closerange.features.grid_orientation import refusal
from closerange.features.pattern import DiscGrid
from closerange.features.plane_map import mapped, plane_homography
from closerange.geometry.arrays import FloatArray

PLACE_TOLERANCE = 0.25
"""Largest distance of a disc from its predicted place, in pitches. Centres are measured to
0.01 pitches; the room is for extrapolation to the rim of a grid of few, widely spaced discs
in a wide-angle image (0.2 pitches for 3 x 3 discs filling a 60 degree view at 14 % barrel)."""

SIZE_TOLERANCE = 1.3
"""Largest factor between measured and predicted diameter. Blur and threshold change small
discs by up to 10 %, a wide lens by up to 15 % towards the corners."""

SHAPE_TOLERANCE = 1.4
"""Largest factor between measured and predicted axis ratio: 20 % from an ellipse of two or
three pixels' semi-axis, as much from perspective that four discs alone do not fix."""

REACH = 2
MIN_NEIGHBOURS = 6
"""A homography needs 4; two more make its prediction a check."""


def clean(nodes: Nodes, candidates: Candidates, grid: DiscGrid) -> Nodes:
    """Take out what does not fit its neighbours, then fill the gaps that the rest predicts.

    Parameters
    ----------
    nodes : dict of (int, int) to int
        A grown lattice.
    candidates : Candidates
        M discs.
    grid : DiscGrid
        Pitch and diameters.

    Returns
    -------
    dict of (int, int) to int
        Empty if the sizes contradict the target altogether.

    Raises
    ------
    DetectionError
        If two candidates claim one place.
    """
    nodes = _pruned(nodes, candidates, grid)
    while True:
        added = _fill(nodes, candidates, grid)
        if not added:
            break
        nodes |= added
    return _with_best_claims(_pruned(nodes, candidates, grid), candidates, grid)


def size_ratios(nodes: Nodes, candidates: Candidates, grid: DiscGrid) -> FloatArray:
    """Return measured over predicted ordinary diameter of each node; NaN where unknown.

    Parameters
    ----------
    nodes : dict of (int, int) to int
        A lattice of n discs.
    candidates : Candidates
        M discs.
    grid : DiscGrid
        Pitch and diameter.

    Returns
    -------
    ndarray, shape (n,)
        In the order of `nodes`. About 1 for an ordinary disc.
    """
    ratios = np.full(len(nodes), np.nan)
    for row, (node, index) in enumerate(nodes.items()):
        local = _local_map(node, nodes, candidates)
        if local is None:
            local = _local_map(node, nodes, candidates, least=4, with_itself=True)
        if local is not None:
            ratios[row] = _size_ratio(index, local[1], candidates, grid)
    return ratios


def _local_map(
    node: Node,
    nodes: Nodes,
    candidates: Candidates,
    *,
    least: int = MIN_NEIGHBOURS,
    with_itself: bool = False,
) -> tuple[FloatArray, FloatArray] | None:
    """Predict image point and steps at a place from the discs around it."""
    near = [
        (i, j)
        for i in range(-REACH, REACH + 1)
        for j in range(-REACH, REACH + 1)
        if (i or j or with_itself) and (node[0] + i, node[1] + j) in nodes
    ]
    if len(near) < least:
        return None
    index = [nodes[node[0] + i, node[1] + j] for i, j in near]
    homography = plane_homography(np.array(near, dtype=np.float64), candidates.xy_px[index])
    if homography is None or abs(homography[2, 2]) < 1e-12:
        return None
    return mapped(homography, np.zeros(2))


def _size_ratio(index: int, steps: FloatArray, candidates: Candidates, grid: DiscGrid) -> float:
    expected = expected_radius(steps, grid)
    return float(candidates.radius_px[index]) / expected if expected > 0 else np.inf


def _badness(
    index: int, local: tuple[FloatArray, FloatArray], candidates: Candidates, grid: DiscGrid
) -> float:
    """Return error over tolerance, of place or of size, whichever is worse; above 1 is bad."""
    point, steps = local
    if not abs(np.linalg.det(steps)) > 0:
        return np.inf
    offset = np.linalg.solve(steps.T, candidates.xy_px[index] - point)
    return max(
        float(np.linalg.norm(offset)) / PLACE_TOLERANCE,
        _form_badness(index, steps, candidates, grid),
    )


def _form_badness(index: int, steps: FloatArray, candidates: Candidates, grid: DiscGrid) -> float:
    """Return error over tolerance of size or axis ratio, whichever is worse."""
    ratio = _size_ratio(index, steps, candidates, grid)
    if not 0 < ratio < np.inf:
        return np.inf
    classes = np.unique(grid.diameters_mm / grid.disc_diameter_mm)
    size = np.abs(np.log(ratio / classes)).min() / np.log(SIZE_TOLERANCE)
    # the disc's own ellipse turns the plate's unit vectors back into a right-angled pair
    plate = candidates.whitener[index] @ (steps.T / np.array(grid.pitch_mm))
    longest, shortest = np.linalg.svd(plate, compute_uv=False)
    shape = np.log(longest / shortest) / np.log(SHAPE_TOLERANCE)
    return float(max(size, shape))


def _pruned(nodes: Nodes, candidates: Candidates, grid: DiscGrid) -> Nodes:
    """Take out the discs that fit worst in their own surroundings until all fit."""
    nodes = dict(nodes)
    ratios = size_ratios(nodes, candidates, grid)
    known = ratios[np.isfinite(ratios)]
    if len(known) and abs(np.log(np.median(known))) > np.log(SIZE_TOLERANCE):
        return {}  # another lattice, for instance every second disc
    while True:
        bad = {}
        for node, index in nodes.items():
            local = _local_map(node, nodes, candidates)
            if local is not None:
                badness = _badness(index, local, candidates, grid)
            else:  # too few around it to tell its place, but perhaps its form
                local = _local_map(node, nodes, candidates, least=4, with_itself=True)
                badness = 0.0 if local is None else _form_badness(index, local[1], candidates, grid)
            if badness > 1:
                bad[node] = badness
        # a bad disc spoils its neighbours' predictions: only the worst of each group goes
        worst = [
            node
            for node, badness in bad.items()
            if all(
                badness >= bad.get((node[0] + i, node[1] + j), 0.0)
                for i in range(-REACH, REACH + 1)
                for j in range(-REACH, REACH + 1)
            )
        ]
        if not worst:
            return nodes
        for node in worst:
            del nodes[node]


def _fill(nodes: Nodes, candidates: Candidates, grid: DiscGrid) -> Nodes:
    """Find free candidates at the empty places in the lattice's bounding box and around it."""
    added: Nodes = {}
    if not nodes:
        return added
    taken = set(nodes.values())
    i, j = np.array(list(nodes)).T
    # one place more on each side: growing stops where perspective is steep
    columns, rows = (range(int(part.min()) - 1, int(part.max()) + 2) for part in (i, j))
    for node in product(columns, rows):
        local = None if node in nodes else _local_map(node, nodes, candidates)
        if local is None:
            continue
        claims = _claims(local, candidates, grid, taken)
        if claims:
            added[node] = claims[0][1]
            taken.add(claims[0][1])
    return added


def _claims(
    local: tuple[FloatArray, FloatArray], candidates: Candidates, grid: DiscGrid, taken: set[int]
) -> list[tuple[float, int]]:
    """Return (badness, candidate) of the free candidates that fit a place, best first."""
    reach = PLACE_TOLERANCE * float(np.linalg.norm(local[1], axis=1).sum())
    if not np.isfinite(local[0]).all() or not np.isfinite(reach):
        return []
    near = candidates.tree.query_ball_point(local[0], reach)
    rated = ((_badness(i, local, candidates, grid), int(i)) for i in near if i not in taken)
    return sorted(claim for claim in rated if claim[0] <= 1)


def _with_best_claims(nodes: Nodes, candidates: Candidates, grid: DiscGrid) -> Nodes:
    """Give each place to the candidate that fits it clearly best."""
    taken = set(nodes.values())
    result = dict(nodes)
    for node, index in nodes.items():
        local = _local_map(node, nodes, candidates)
        rivals = [] if local is None else _claims(local, candidates, grid, taken)
        if local is None or not rivals:
            continue
        badness, rival = rivals[0]
        own = _badness(index, local, candidates, grid)
        if badness < own / 2:
            result[node] = rival
        elif badness < 2 * own:
            x, y = candidates.xy_px[index]
            raise refusal(
                len(candidates),
                grid,
                f"two of them claim one place of the grid near ({x:.0f}, {y:.0f}) px",
                "cover or remove other round things near the target",
            )
    return result
