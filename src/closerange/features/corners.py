"""Corners of parts to a fraction of a pixel: where straight pieces of edges meet."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from closerange.features.edge_chains import chain_numbers
from closerange.features.edges import EdgePoints
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints

NEAR_PX = 2.5
"""Edge points nearer to a corner than this are left out: the blur of the image and of the edge
operator, 1 px together, rounds the corner over two and a half of its standard deviations."""

FAR_PX = 10.0
"""Edge points farther away are left out: an arm is then as long as the shortest chain of edges and
a little more, and edges may be curved beyond."""

FEWEST = 5
"""Edge points of an arm: fewer do not tell its direction to better than some degrees."""

ALIGNED = (0.8, 0.9, 0.95)
"""Least cosine between an edge and the way to the corner at each of three looks: the first knows
the corner to some 3 px, which is 37 degrees for points 5 px away; at the last 18 degrees remain."""

GAP_RAD = np.deg2rad(10.0)
"""Gap between the directions in which edge points lie, seen from the corner, that parts two arms:
an arm without gaps of its own spans less from one point to the next."""

SHARPEST_RAD = np.deg2rad(55.0)
"""Least angle between two arms of a corner: between arms that meet at less, the blur of each moves
the other, and the corner outwards (by 0.3 px at 55 degrees, by 0.7 at 45)."""

TURN_RAD = np.deg2rad(50.0)
"""Least angle by which an edge turns at a corner. Where it turns by less, it may be a circle of
14 px radius or more; the arms of a smaller one are not straight."""

MOVED_PX = 4.0
"""A corner farther than this from where the image turns most belongs to other edges: that place
lies inside of the corner, by up to half of the window plus the blur."""

DISTINCT_PX = 2.5
"""Corners nearer to each other than this are one."""

MISSED = 3.0
"""Standard deviations by which the arms of a corner may miss it."""

PEAK_PX = 5
"""Side of the window over which the structure of a corner is summed."""


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of one image and the edges that meet there; N corners, K edge points on their arms.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Intersections of the arms.
    cov_px2 : ndarray, shape (N, 2, 2)
        Covariances, from the noise and the shape of the edges.
    corner, arm : ndarray of int, shape (K,)
        Corner and number of the arm of it, for each point.
    point : ndarray of int, shape (K,)
        Row in `EdgePoints`.
    along_px : ndarray, shape (K,)
        Distance from the corner, along the arm.
    """

    xy_px: FloatArray
    cov_px2: FloatArray
    corner: IntArray
    arm: IntArray
    point: IntArray
    along_px: FloatArray

    def __post_init__(self) -> None:
        count, points = len(self.xy_px), len(self.point)
        for name, shape in (
            ("xy_px", (count, 2)),
            ("cov_px2", (count, 2, 2)),
            ("along_px", (points,)),
        ):
            object.__setattr__(self, name, frozen_array(getattr(self, name), shape, name))
        for name in ("corner", "arm", "point"):
            object.__setattr__(self, name, frozen_ints(getattr(self, name), (points,), name))

    def __len__(self) -> int:
        return len(self.xy_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Arm:
    """A straight piece of edge: its points and the line through them."""

    point: IntArray
    normal: FloatArray
    middle: FloatArray
    outward: FloatArray
    std_px: float  # of the line, across itself, at the corner


def find_corners(pixels: NDArray[Any], edges: EdgePoints) -> Corners:
    """Find corners as intersections of straight pieces of edges.

    Places where the image turns in two directions (the smaller eigenvalue of the structure tensor,
    doi:10.1109/CVPR.1994.323794) are looked at; a corner is what two or more arms of edge points
    run towards. Lines through the arms do not suffer from the blur that rounds the corner itself,
    which moves the usual gradient-based estimates inwards.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values.
    edges : EdgePoints
        Edges of the same image.

    Returns
    -------
    Corners
        By rows of the image, from top to bottom. A junction at which one edge passes in front of
        another is found too; only a second view can tell.
    """
    if not len(edges):
        return _collected(edges, [])
    starts = _starts(pixels, edges)
    tree = cKDTree(edges.xy_px)
    chain = chain_numbers(edges.after)
    found: list[tuple[FloatArray, FloatArray, list[_Arm]]] = []
    for start in starts:
        near = np.array(tree.query_ball_point(start, FAR_PX + MOVED_PX), dtype=np.int64)
        corner = _corner(edges, chain, near, start)
        if corner is not None and np.linalg.norm(corner[0] - start) <= MOVED_PX:
            found.append(corner)
    found.sort(key=lambda item: (item[0][1], item[0][0]))
    return _collected(edges, _distinct(found))


def _starts(pixels: NDArray[Any], edges: EdgePoints) -> FloatArray:
    """Return the pixels, beside edges, where the image turns more than at their neighbours."""
    smooth = cv2.GaussianBlur(np.asarray(pixels, dtype=np.float32), (0, 0), 0.7)
    turning = cv2.cornerMinEigenVal(smooth, PEAK_PX, ksize=3)
    beside = np.zeros(turning.shape, dtype=np.uint8)
    column, row = np.rint(edges.xy_px).astype(np.int64).T
    beside[row, column] = 1
    beside = cv2.dilate(beside, np.ones((PEAK_PX, PEAK_PX), np.uint8))
    highest = cv2.dilate(turning, np.ones((PEAK_PX, PEAK_PX), np.uint8))
    row, column = np.nonzero((turning >= highest) & (beside > 0) & (turning > 0))
    return np.column_stack([column, row]).astype(np.float64)


def _corner(
    edges: EdgePoints, chain: IntArray, near: IntArray, start: FloatArray
) -> tuple[FloatArray, FloatArray, list[_Arm]] | None:
    """Return place, covariance and arms of the corner at a place; None if there is none."""
    meeting: tuple[FloatArray, FloatArray, list[_Arm]] | None = (start, np.eye(2), [])
    for aligned in ALIGNED:
        if meeting is not None:
            meeting = _meeting(_arms(edges, chain[near], near, meeting[0], aligned))
    return meeting


def _meeting(arms: list[_Arm]) -> tuple[FloatArray, FloatArray, list[_Arm]] | None:
    """Intersect arms; leave out those that miss the place where the others meet."""
    while len(arms) >= 2:
        if not _turn(arms):
            return None
        normals = np.array([arm.normal for arm in arms])
        weight = np.array([arm.std_px**-2 for arm in arms])
        offset = np.array([arm.normal @ arm.middle for arm in arms])
        cov = np.linalg.inv(np.einsum("k,ki,kj->ij", weight, normals, normals))
        place = cov @ (normals.T @ (weight * offset))
        missed = np.abs((normals @ place - offset) * np.sqrt(weight))
        if missed.max() <= MISSED:
            return place, cov, arms
        rests = [arms[:out] + arms[out + 1 :] for out in range(len(arms))]
        arms = min(rests, key=_misfit)
    return None


def _misfit(arms: list[_Arm]) -> float:
    """Return the weighted sum of squares by which arms miss each other; infinite without angle."""
    if not _turn(arms):
        return np.inf
    normals = np.array([arm.normal for arm in arms])
    weight = np.array([arm.std_px**-2 for arm in arms])
    offset = np.array([arm.normal @ arm.middle for arm in arms])
    matrix = normals * np.sqrt(weight)[:, None]
    place = np.linalg.lstsq(matrix, np.sqrt(weight) * offset, rcond=None)[0]
    # with two arms nothing is left over: the better known ones are preferred
    return float(np.sum((matrix @ place - np.sqrt(weight) * offset) ** 2) + np.sum(1 / weight))


def _arms(
    edges: EdgePoints, chain: IntArray, near: IntArray, place: FloatArray, aligned: float
) -> list[_Arm]:
    """Group edge points that run towards a place, by chain and direction."""
    way = edges.xy_px[near] - place
    distance = np.linalg.norm(way, axis=1)
    inside = (distance >= NEAR_PX) & (distance <= FAR_PX)
    towards = np.abs(np.einsum("ni,ni->n", way, edges.tangent[near])) >= aligned * distance
    rows = np.flatnonzero(inside & towards)
    angle = np.arctan2(way[rows, 1], way[rows, 0])
    arms = []
    for number in np.unique(chain[rows]):
        mine = rows[chain[rows] == number]
        for group in _by_direction(angle[chain[rows] == number]):
            arm = _arm(edges, near[mine[group]], place)
            if arm is not None:
                arms.append(arm)
    return arms


def _by_direction(angle_rad: FloatArray) -> list[IntArray]:
    """Group directions between which there is no gap; indices of each group."""
    order = np.argsort(angle_rad, kind="stable")
    ordered = angle_rad[order]
    # gap to the previous one, round the circle
    first = np.diff(np.r_[ordered[-1] - 2 * np.pi, ordered]) > GAP_RAD
    if not first.any():  # edges in all directions: a texture, no corner
        return []
    turn = int(np.flatnonzero(first)[0])
    group = np.cumsum(np.roll(first, -turn))
    order = np.roll(order, -turn)
    return [order[group == number] for number in range(1, int(group[-1]) + 1)]


def _arm(edges: EdgePoints, point: IntArray, place: FloatArray) -> _Arm | None:
    """Fit a line to the points of an arm; None if they are too few or not on one line."""
    if len(point) < FEWEST:
        return None
    xy_px = edges.xy_px[point]
    middle = xy_px.mean(axis=0)
    _, _, axes = np.linalg.svd(xy_px - middle)
    along = (xy_px - middle) @ axes[0]
    spread = float(along @ along)
    noise = float(np.mean(edges.noise_px[point] ** 2))
    model = float(np.mean(edges.model_px[point] ** 2))
    scatter = float(np.sum(((xy_px - middle) @ axes[1]) ** 2)) / (len(point) - 2)
    if np.ptp(along) < FEWEST - 1 or scatter > MISSED**2 * (noise + model):
        return None
    lever = float((place - middle) @ axes[0]) ** 2 / spread
    variance = max(noise, scatter) * (1 / len(point) + lever) + model
    outward = axes[0] * np.sign((middle - place) @ axes[0])
    return _Arm(point, axes[1], middle, outward, float(np.sqrt(variance)))


def _turn(arms: list[_Arm]) -> bool:
    """Tell whether two of the arms form an angle, neither too sharp nor nearly straight."""
    outward = np.array([arm.outward for arm in arms]).reshape(-1, 2)
    cosine = outward @ outward.T
    sharpest, bluntest = np.cos(SHARPEST_RAD), -np.cos(TURN_RAD)
    return bool(((cosine < sharpest) & (cosine > bluntest)).any())


def _distinct(
    found: list[tuple[FloatArray, FloatArray, list[_Arm]]],
) -> list[tuple[FloatArray, FloatArray, list[_Arm]]]:
    """Keep one of several corners at one place: the one that is known best."""
    kept: list[tuple[FloatArray, FloatArray, list[_Arm]]] = []
    for item in sorted(found, key=lambda item: float(np.trace(item[1]))):
        if all(np.linalg.norm(item[0] - other[0]) > DISTINCT_PX for other in kept):
            kept.append(item)
    return sorted(kept, key=lambda item: (item[0][1], item[0][0]))


def _collected(
    edges: EdgePoints, found: list[tuple[FloatArray, FloatArray, list[_Arm]]]
) -> Corners:
    corner, arm, point, along = [], [], [], []
    for number, (place, _, arms) in enumerate(found):
        for which, piece in enumerate(arms):
            corner += [number] * len(piece.point)
            arm += [which] * len(piece.point)
            point += piece.point.tolist()
            along += np.linalg.norm(edges.xy_px[piece.point] - place, axis=1).tolist()
    return Corners(
        np.array([item[0] for item in found]).reshape(-1, 2),
        np.array([item[1] for item in found]).reshape(-1, 2, 2),
        np.array(corner, dtype=np.int64),
        np.array(arm, dtype=np.int64),
        np.array(point, dtype=np.int64),
        np.array(along, dtype=np.float64),
    )
