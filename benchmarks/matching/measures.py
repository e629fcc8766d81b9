"""Figures of one method on one scene."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from closerange.matching.pencil import Pencil
from closerange.position.triangulate import solve_points
from matching.method import BoolArray, FloatArray, Matches
from matching.scene_truth import Kind
from matching.scenes import Scene

FINE_PX = 0.1
NORMAL_95 = 1.959964
LINKED_PX = 2.0
"""Points of one chain are at most a diagonal step and its sub-pixel shifts apart."""

FACE = 30
"""More wrong points than this in one piece are a wrong face, not stray blunders."""

EXACT_PX = 1e-3
"""The truth lies on the ray of the very point: its own uncertainty is no part of the error."""

USUAL_PX = 0.1
"""Standard deviation assumed for methods that state none; positions do not depend on it."""


@dataclass(frozen=True, slots=True)
class Stage:
    """What is right among what one filter keeps; shares of 1."""

    precision: float
    recall: float
    within_fine: float
    kept: int


@dataclass(frozen=True, slots=True)
class Figures:
    """All figures; NaN where there is nothing to judge.

    `raw` and `raw_fine`: share of the visible points within `Scene.right_px` and 0.1 px, before
    filters. `checked`: after the left-right check, `final`: without any flag. `recall` is the
    share of the visible points that is kept and right. Heights in mm, of the final points that are
    visible (all of them for p95, the right ones for `height_right_p95`). `median_px` is the whole
    distance from the truth, `median_along_px` its part along the epipolar curve.
    """

    points: int
    visible: int
    occluded: int
    surface: int
    raw: float
    raw_fine: float
    checked: Stage
    final: Stage
    occluded_kept: float
    height_median: float
    height_p95: float
    height_right_p95: float
    median_px: float
    median_along_px: float
    wrong_faces: int
    cover_px: float
    cover_mm: float
    surface_final: Stage

    def as_dict(self) -> dict[str, object]:
        """Return them ready for JSON."""
        return asdict(self)


def figures(scene: Scene, matches: Matches) -> Figures:
    """Judge what a method found."""
    kind = scene.truth.kind
    visible, hidden = kind == int(Kind.edge), kind == int(Kind.occluded)
    surface = kind == int(Kind.surface)
    error = np.linalg.norm(matches.xy_px - scene.truth.xy_px, axis=1)
    error = np.where(np.isfinite(error), error, np.inf)
    good = visible & (error < scene.right_px)
    found = np.isfinite(matches.xy_px).all(axis=1)
    checked, final = matches.checked & found, (matches.flags == 0) & found
    height, height_std = _heights(scene, matches, final & visible)
    wrong = final & (hidden | (visible & ~good))
    kept_error = error[final & visible]
    return Figures(
        points=len(kind),
        visible=int(visible.sum()),
        occluded=int(hidden.sum()),
        surface=int(surface.sum()),
        raw=_share(good, visible),
        raw_fine=_share(visible & (error < FINE_PX), visible),
        checked=_stage(checked, good, visible, hidden, error),
        final=_stage(final, good, visible, hidden, error),
        occluded_kept=_share(hidden & final, hidden),
        height_median=_quantile(height, 0.5),
        height_p95=_quantile(height, 0.95),
        height_right_p95=_quantile(height[good[final & visible][: len(height)]], 0.95),
        median_px=_quantile(kept_error, 0.5),
        median_along_px=_median_along(scene, matches, final & visible),
        wrong_faces=wrong_faces(scene.xy_px, wrong),
        cover_px=_cover_px(scene, matches, final & visible),
        cover_mm=np.nan if matches.cov_px2 is None else _mean(height < NORMAL_95 * height_std),
        surface_final=_stage(
            final, surface & (error < scene.right_px), surface, np.zeros_like(surface), error
        ),
    )


def wrong_faces(xy_px: FloatArray, wrong: BoolArray) -> int:
    """Count connected pieces of more than `FACE` wrong points."""
    points = xy_px[wrong]
    if len(points) <= FACE:
        return 0
    pairs = cKDTree(points).query_pairs(LINKED_PX, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    _, piece = connected_components(graph, directed=False)
    return int(np.count_nonzero(np.bincount(piece) > FACE))


def tail(scene: Scene, matches: Matches) -> dict[str, int]:
    """Say what the final points outside of their 95 % regions are made of."""
    rows = (matches.flags == 0) & (scene.truth.kind == int(Kind.edge))
    rows &= np.isfinite(matches.xy_px).all(axis=1)
    if matches.cov_px2 is None or not rows.any():
        return {}
    along, sine = _along(scene, matches.xy_px, matches.cov_px2, rows)
    outside = np.abs(along) > NORMAL_95
    error = np.linalg.norm(matches.xy_px - scene.truth.xy_px, axis=1)[rows]
    open_px = scene.truth.spread_px[rows]
    return {
        "outside": int(outside.sum()),
        "wrong": int((outside & (error > scene.right_px)).sum()),
        "truth_open": int((outside & (error < scene.right_px) & (open_px > FINE_PX)).sum()),
        "beyond_3_sigma": int((np.abs(along) > 3).sum()),
        "of": int(rows.sum()),
        "median_std_um_px": int(1000 * np.median(sine)),
    }


def _stage(
    kept: BoolArray, good: BoolArray, visible: BoolArray, hidden: BoolArray, error: FloatArray
) -> Stage:
    right = kept & good
    return Stage(
        precision=_share(right, kept & (visible | hidden)),
        recall=_share(right, visible),
        within_fine=_share(kept & visible & (error < FINE_PX), kept & visible),
        kept=int(np.count_nonzero(kept & visible)),
    )


def _heights(scene: Scene, matches: Matches, rows: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return errors along world Z and their stated standard deviations, mm."""
    if not scene.heights or not rows.any():
        return np.empty(0), np.empty(0)
    rig = scene.measuring_rig()
    order = [
        [camera.name for camera in rig.cameras].index(camera.name) for camera in scene.cameras[:2]
    ]
    count = int(rows.sum())
    seen = np.full((count, len(rig.cameras), 2), np.nan)
    cov = np.broadcast_to(np.eye(2), (count, len(rig.cameras), 2, 2)).copy()
    used = np.zeros((count, len(rig.cameras)), np.bool_)
    seen[:, order[0]], cov[:, order[0]] = scene.xy_px[rows], EXACT_PX**2 * np.eye(2)
    seen[:, order[1]] = matches.xy_px[rows]
    own = None if matches.cov_px2 is None else matches.cov_px2[rows]
    cov[:, order[1]] = USUAL_PX**2 * np.eye(2) if own is None else own
    used[:, order] = True
    solution = solve_points(rig, seen, cov, used)
    total = solution.image_cov_mm2 + solution.calibration_cov_mm2
    error = np.abs(solution.xyz_mm[:, 2] - scene.truth.xyz_mm[rows, 2])
    return np.where(np.isfinite(error), error, np.inf), np.sqrt(total[:, 2, 2])


def _cover_px(scene: Scene, matches: Matches, rows: BoolArray) -> float:
    if matches.cov_px2 is None or not rows.any():
        return float("nan")
    along, _ = _along(scene, matches.xy_px, matches.cov_px2, rows)
    return _mean(np.abs(along) < NORMAL_95)


def _median_along(scene: Scene, matches: Matches, rows: BoolArray) -> float:
    """Return the median error along the epipolar curves: matches lie on them by construction."""
    if not rows.any():
        return float("nan")
    exact = np.broadcast_to(np.eye(2), (len(rows), 2, 2))
    return _quantile(np.abs(_along(scene, matches.xy_px, exact, rows)[0]), 0.5)


def _along(
    scene: Scene, xy_px: FloatArray, cov_px2: FloatArray, rows: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return errors along the epipolar curves in standard deviations, and these in px."""
    first, second = scene.cameras[:2]
    way = _epipolar(first, second, scene.xy_px[rows], xy_px[rows])
    error = np.sum((xy_px[rows] - scene.truth.xy_px[rows]) * way, axis=1)
    std = np.sqrt(np.einsum("ni,nij,nj->n", way, cov_px2[rows], way))
    return error / std, std


def _epipolar(first: object, second: object, here: FloatArray, there: FloatArray) -> FloatArray:
    """Return unit vectors along the epipolar curves at the matches."""
    pencil = Pencil.of(first, second)  # type: ignore[arg-type]
    theta, slope = pencil.coordinates(pencil.first, here)
    _, other = pencil.coordinates(pencil.second, there)
    point = pencil.point(theta, slope, other)
    jacobian = pencil.second.project_jacobian(point)
    way = np.einsum("nij,nj->ni", jacobian, point - pencil.first.centre_mm)
    unit: FloatArray = way / np.linalg.norm(way, axis=1, keepdims=True)
    return unit


def _share(part: BoolArray, whole: BoolArray) -> float:
    count = int(np.count_nonzero(whole))
    return np.count_nonzero(part) / count if count else float("nan")


def _mean(values: NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: FloatArray, share: float) -> float:
    return float(np.quantile(values, share, method="lower")) if len(values) else float("nan")
