"""Exact truth of matches on rendered scenes: where a point of one view lies in the world.

A point within 1 px of a sharp mesh edge that both views see, and that runs as it does, is that
edge: its depth is the edge's at the foot of the point, taken on the point's own ray, so that the
truth is the surface point seen at that pixel and the error of edge detection is no part of it.
All other points have the depth map's nearer surface. What they are follows from the truth maps
alone, never from names of objects, so that scenes of other parts are classified alike.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal
from matching.depth_contours import BoolArray, DepthContours, FloatArray
from matching.mesh_edges import MeshEdges

WITHIN_PX = 1.0
"""Distance of an image edge from its mesh edge: blur, chamfers and shading move it by less."""

CONTOUR_PX = 2.0
"""Distance from a tear of the depth map within which a point belongs to it: both are whole pixels
and the image edge of a dim surface lies up to a pixel off."""

SURFACE_MM = 1.5
"""Depth by which a point may miss a map's surface within a pixel and still lie on it."""


class Kind(IntEnum):
    """What a point of the first view is."""

    edge = 0  # on a surface edge that both views see
    surface = 1  # on a smooth surface that both see: print, shadow, shading, reflection, noise
    occluded = 2  # hidden in the other view
    outline = 3  # outline, highlight or shading of a curved body: bound to no surface point
    unknown = 4  # at a tear of the depth map without a mesh edge, or at the border of the visible


@dataclass(frozen=True, slots=True, eq=False)
class PointTruth:
    """Truth of M points.

    Attributes
    ----------
    kind : ndarray of int, shape (M,)
        `Kind`.
    xyz_mm : ndarray, shape (M, 3)
        World point on the ray of each.
    xy_px : ndarray, shape (M, 2)
        Its place in the second view.
    spread_px : ndarray, shape (M,)
        How far apart in the second view are the mesh edges that are equally near to the point:
        what the truth itself leaves open (chamfers, edges that cover each other); 0 elsewhere.
    """

    kind: NDArray[np.int64]
    xyz_mm: FloatArray
    xy_px: FloatArray
    spread_px: FloatArray

    def __len__(self) -> int:
        return len(self.kind)

    def select(self, rows: Any) -> PointTruth:
        """Keep some points."""
        return PointTruth(
            self.kind[rows], self.xyz_mm[rows], self.xy_px[rows], self.spread_px[rows]
        )


def read_cameras(folder: Path) -> dict[str, Camera]:
    """Read the true cameras of a folder's ``cameras.json``."""
    document: dict[str, Any] = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))
    return {
        name: Camera(
            name,
            (true["width"], true["height"]),
            np.array(true["K"], np.float64),
            RigidTransform(np.array(true["R"]), np.array(true["t_mm"])),
            BrownIdeal(*true["dist_k1_k2_p1_p2_k3"]),
        )
        for name, true in document["cameras"].items()
    }


class SceneTruth:
    """Truth of one folder, seen from one camera.

    Parameters
    ----------
    folder : Path
        With ``cameras.json``, ``edge_points.csv`` and ``truth_<camera>.npz``.
    first, second : str
        Camera of the points and camera of their matches.
    """

    def __init__(self, folder: Path, first: str = "left", second: str = "right") -> None:
        cameras = read_cameras(folder)
        self.first, self.second = cameras[first], cameras[second]
        with np.load(folder / f"truth_{first}.npz") as maps:
            self.depth_mm = maps["depth"].astype(np.float64)
            height, width = self.depth_mm.shape
            bits = np.unpackbits(maps[f"visible_in_{second}"])[: height * width]
        self.visible: BoolArray = bits.reshape(height, width).astype(bool)
        with np.load(folder / f"truth_{second}.npz") as maps:
            self._second_depth_mm = maps["depth"].astype(np.float64)
        self.edges = MeshEdges.read(folder / "edge_points.csv")
        self.contours = DepthContours.of(self.depth_mm)
        # distance of each pixel from the near side of a tear, and which pixel that is
        self._tear_px, self._tear = distance_transform_edt(~self.contours.near, return_indices=True)

    def of(self, xy_px: FloatArray, tangent: FloatArray | None = None) -> PointTruth:
        """Return the truth of points.

        Parameters
        ----------
        xy_px : ndarray, shape (M, 2)
            Points of the first view, to a fraction of a pixel.
        tangent : ndarray, shape (M, 2), optional
            Unit vectors along their image edges; with them a point where edges cross is not
            taken for one of the other edge.

        Returns
        -------
        PointTruth
            M points.
        """
        xy = np.asarray(xy_px, np.float64)
        foot, away, rivals = self.edges.feet(self.first, xy, tangent, WITHIN_PX)
        on_edge = away <= WITHIN_PX
        kind, depth = self._by_maps(xy)
        depth[on_edge] = self.first.depth_mm(foot[on_edge])
        kind[on_edge] = int(Kind.edge)
        xyz = self._on_ray(xy, depth)
        spread = np.zeros(len(xy))
        for point in np.flatnonzero(on_edge):
            options = self.first.depth_mm(rivals[point])
            ends = np.array([options.min(), options.max()])
            if np.ptp(ends) > 1e-3:
                ends_px = self.second.project(self._on_ray(xy[[point, point]], ends))
                spread[point] = np.linalg.norm(np.diff(ends_px, axis=0))
        return PointTruth(kind, xyz, self.second.project(xyz), spread)

    def checked(self, truth: PointTruth, found_px: FloatArray) -> dict[str, float]:
        """Check visible edge points against everything that did not make them.

        Parameters
        ----------
        truth : PointTruth
            Of points of the first view.
        found_px : ndarray, shape (K, 2)
            Edge points found in the second image.

        Returns
        -------
        dict of str to float
            Shares of the points of kind ``edge``: hidden in the second view's own depth map;
            without an edge of the second image within 1.5 px; and the median distance, px, of
            the others from it.
        """
        rows = np.flatnonzero(truth.kind == int(Kind.edge))
        if not len(rows) or not len(found_px):
            return {"points": float(len(rows)), "hidden": 0.0, "no_edge": 1.0, "median_px": np.nan}
        hidden = ~self.seen(truth.xyz_mm[rows])
        away, _ = cKDTree(found_px).query(truth.xy_px[rows])
        near = away < 1.5
        return {
            "points": float(len(rows)),
            "hidden": float(hidden.mean()),
            "no_edge": float((~near).mean()),
            "median_px": float(np.median(away[near])) if near.any() else np.nan,
        }

    def seen(self, xyz_mm: FloatArray) -> BoolArray:
        """Tell which world points the second view's own depth map has on its surface."""
        xy = self.second.project(xyz_mm)
        depth = self.second.depth_mm(xyz_mm)
        height, width = self._second_depth_mm.shape
        column, row = np.rint(np.nan_to_num(xy, nan=-9.0)).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
        padded = np.pad(self._second_depth_mm, 1, mode="edge")
        around = np.stack([padded[row + i, column + j] for i in range(3) for j in range(3)])
        # hidden where even the farthest surface around lies before the point
        return np.asarray(inside & (around.max(axis=0) > depth - SURFACE_MM))

    def _by_maps(self, xy: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
        """Return kind and depth by the maps of the first view."""
        height, width = self.depth_mm.shape
        column = np.clip(np.rint(xy[:, 0]).astype(int), 0, width - 1)
        row = np.clip(np.rint(xy[:, 1]).astype(int), 0, height - 1)
        torn = self._tear_px[row, column] <= CONTOUR_PX
        # at a tear the point belongs to the nearer surface
        near_row, near_column = self._tear[:, row, column]
        row, column = np.where(torn, near_row, row), np.where(torn, near_column, column)
        around = self._visible_around(row, column)
        curved = torn & self._around(self.contours.curved, row, column)
        kind = np.full(len(xy), int(Kind.surface))
        # at the border of what is visible a pixel more or less decides
        kind[torn | (around & ~self.visible[row, column])] = int(Kind.unknown)
        kind[~around] = int(Kind.occluded)
        kind[curved | self.contours.round[row, column]] = int(Kind.outline)
        return kind, self.depth_mm[row, column]

    def _visible_around(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> BoolArray:
        """Tell whether the surface at pixels is visible, there or on the same surface beside it."""
        height, width = self.depth_mm.shape
        own = self.depth_mm[row, column]
        seen = np.zeros(len(row), np.bool_)
        for down in (-1, 0, 1):
            for across in (-1, 0, 1):
                r = np.clip(row + down, 0, height - 1)
                c = np.clip(column + across, 0, width - 1)
                same = np.abs(self.depth_mm[r, c] - own) < SURFACE_MM
                seen |= same & self.visible[r, c]
        return seen

    @staticmethod
    def _around(mask: BoolArray, row: NDArray[np.intp], column: NDArray[np.intp]) -> BoolArray:
        """Tell whether most marks of contours within a pixel are set: single pixels may err."""
        padded = np.pad(mask, 1)
        count = sum(padded[row + i, column + j].astype(int) for i in (0, 1, 2) for j in (0, 1, 2))
        return np.asarray(count >= 2)

    def _on_ray(self, xy: FloatArray, depth_mm: FloatArray) -> FloatArray:
        direction = self.first.directions(xy)
        forward = direction @ self.first.camera_from_world.rotation[2]
        return np.asarray(self.first.centre_mm + direction * (depth_mm / forward)[:, None])
