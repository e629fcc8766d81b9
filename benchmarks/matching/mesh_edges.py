"""Sharp mesh edges of a rendered scene as fine samples of smooth curves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from closerange.rig.camera import Camera

FloatArray = NDArray[np.float64]
Table = NDArray[Any]

REACH_MM = 1.7
"""The tables give a point every millimetre; farther neighbours belong to another piece."""

SIDE_MM = 0.3
"""Way off the straight line of a neighbour on the same edge: a circle of 2 mm radius has it."""

END_MM = 0.5
"""How far an edge reaches beyond its last point: half the spacing."""

SAMPLES = 16
"""Samples per mm: 0.02 px apart at 3 px per mm."""

CHAMFER_MM = 1.5
"""Edges so near to each other in space bound a chamfer; farther ones only look near."""

STEP_PX = 0.3
"""Samples are not farther apart in an image with up to 5 px per mm; nor does an edge reach
farther beyond its last sample."""

ALIGNED = 0.8
"""Cosine between image edge and mesh edge from which on they may be the same."""


@dataclass(frozen=True, slots=True, eq=False)
class MeshEdges:
    """Samples of all mesh edges that both views see; N samples.

    Attributes
    ----------
    xyz_mm, direction : ndarray, shape (N, 3)
        World points and unit vectors along the edge.
    """

    xyz_mm: FloatArray
    direction: FloatArray

    def __len__(self) -> int:
        return len(self.xyz_mm)

    @classmethod
    def read(cls, path: Path) -> MeshEdges:
        """Read ``edge_points.csv`` and draw a cubic through neighbours with their directions."""
        table = np.atleast_1d(
            np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
        )
        xyz = np.column_stack([table[f"{axis}_mm"] for axis in "XYZ"]).astype(np.float64)
        along = np.column_stack([table[f"d{axis}"] for axis in "xyz"]).astype(np.float64)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        pieces = [_piece(xyz, along, i, j) for i, j in _neighbours(xyz, along, table["object_id"])]
        return cls(
            np.concatenate([piece[0] for piece in pieces]),
            np.concatenate([piece[1] for piece in pieces]),
        )

    def feet(
        self, camera: Camera, xy_px: FloatArray, tangent: FloatArray | None, within_px: float
    ) -> tuple[FloatArray, FloatArray, list[FloatArray]]:
        """Return the foot of each image point on the nearest mesh edge that runs as it does.

        Parameters
        ----------
        camera : Camera
            True camera of the image.
        xy_px, tangent : ndarray, shape (M, 2)
            Points and directions of their image edges (None if unknown).
        within_px : float
            Farther edges are not looked at.

        Returns
        -------
        xyz_mm : ndarray, shape (M, 3)
            Foot; NaN where there is none.
        distance_px : ndarray, shape (M,)
            From point to foot.
        rivals : list of ndarray, shape (K, 3)
            The foot and those that would do as well: on other edges within reach and aligned.
        """
        image = camera.project(self.xyz_mm)
        ahead = camera.project(self.xyz_mm + 0.1 * self.direction) - image
        px_per_mm = np.linalg.norm(ahead, axis=1) / 0.1
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        foot, away = np.full((len(xy_px), 3), np.nan), np.full(len(xy_px), np.inf)
        near = cKDTree(image).query_ball_point(xy_px, within_px + STEP_PX)
        rivals = [np.empty((0, 3))] * len(xy_px)
        for point, found in enumerate(near):
            rows = np.array(found, dtype=np.intp)
            if tangent is not None and len(rows):
                rows = rows[np.abs(ahead[rows] @ tangent[point]) > ALIGNED]
            # samples are a fraction of a pixel apart: slide along the edge to the foot itself
            way = np.sum((xy_px[point] - image[rows]) * ahead[rows], axis=1)
            rows, way = rows[np.abs(way) < STEP_PX], way[np.abs(way) < STEP_PX]
            if len(rows):
                own = self.xyz_mm[rows] + (way / px_per_mm[rows])[:, None] * self.direction[rows]
                off = xy_px[point] - image[rows] - way[:, None] * ahead[rows]
                foot[point], away[point] = _between(own, off)
                own = own[np.linalg.norm(own - foot[point], axis=1) > CHAMFER_MM]
                rivals[point] = np.concatenate([foot[[point]], own])
        return foot, away, rivals


def _between(feet: FloatArray, off_px: FloatArray) -> tuple[FloatArray, float]:
    """Return the point seen at a pixel and its distance from the nearest edge.

    Between the two edges of a chamfer it lies on the chamfer, which is flat: in proportion to the
    distances of both feet. Otherwise it is the nearest foot.
    """
    distance = np.linalg.norm(off_px, axis=1)
    best = int(np.argmin(distance))
    near = feet[best]
    opposite = off_px @ off_px[best] < 0
    opposite &= np.linalg.norm(feet - near, axis=1) < CHAMFER_MM
    if opposite.any():
        other = int(np.flatnonzero(opposite)[np.argmin(distance[opposite])])
        share = distance[best] / (distance[best] + distance[other])
        near = near + share * (feet[other] - near)
    return near, float(distance[best])


def _neighbours(xyz: FloatArray, along: FloatArray, part: Table) -> list[tuple[int, int]]:
    """Return pairs of points that follow each other on an edge; (i, -1), (i, -2): i is an end."""
    pairs: set[tuple[int, int]] = set()
    for i, near in enumerate(cKDTree(xyz).query_ball_point(xyz, REACH_MM)):
        rows = np.array([j for j in near if j != i and part[j] == part[i]], dtype=np.intp)
        step = xyz[rows] - xyz[i]
        way = step @ along[i]
        off = np.linalg.norm(step - way[:, None] * along[i], axis=1)
        same = (np.abs(along[rows] @ along[i]) > ALIGNED) & (off < SIDE_MM)
        for end, sense in ((-1, 1), (-2, -1)):
            side = np.flatnonzero(same & (sense * way > 0.05))
            if len(side):
                j = int(rows[side[np.argmin(sense * way[side])]])
                pairs.add((min(i, j), max(i, j)))
            else:
                pairs.add((i, end))
    return sorted(pairs)


def _piece(xyz: FloatArray, along: FloatArray, i: int, j: int) -> tuple[FloatArray, FloatArray]:
    """Sample the cubic from i to j (Hermite), or a straight end of i."""
    if j < 0:
        sense = 1.0 if j == -1 else -1.0
        way = sense * np.linspace(0, END_MM, int(END_MM * SAMPLES) + 1)
        return xyz[i] + way[:, None] * along[i], np.repeat(along[i][None], len(way), axis=0)
    step = xyz[j] - xyz[i]
    length = float(np.linalg.norm(step))
    first = along[i] * np.copysign(length, along[i] @ step)
    last = along[j] * np.copysign(length, along[j] @ step)
    t = np.linspace(0, 1, max(int(length * SAMPLES), 2) + 1)[:, None]
    points = (
        (1 + 2 * t) * (1 - t) ** 2 * xyz[i]
        + t * (1 - t) ** 2 * first
        + t**2 * (3 - 2 * t) * xyz[j]
        + t**2 * (t - 1) * last
    )
    slope = (1 - t) * first + t * last
    return points, slope / np.linalg.norm(slope, axis=1, keepdims=True)
