"""How the pixels of windows are carried into the other view through planes that are fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.matching.window_planes import SeedRays, unit_depth_rays


@dataclass(frozen=True, slots=True, eq=False)
class WindowMapping:
    """Windows of one size around N seeds, P pixels each, and their way into the second view.

    The mapping through a plane is computed exactly, lens and perspective included, at three by
    three nodes of each window, and interpolated between them by parabolas. An affine mapping would
    not do: at 25 degrees between the cameras perspective moves the rim of a disc against its centre
    by hundredths of a pixel, and always to the same side.

    Attributes
    ----------
    rays : SeedRays
        The seeds.
    scale : int
        How many times smaller than the images is the level on which windows are compared.
    corner : ndarray of int, shape (N, 2)
        Pixel in the middle of each window, on that level.
    offset : ndarray of int, shape (P, 2)
        Pixels of the window relative to it.
    weights : ndarray, shape (P, 9)
        Of the nodes, for every pixel.
    along_nodes : ndarray, shape (2, 9, 9)
        Derivatives along x and y at the nodes from the values at the nodes.
    node_ray : ndarray, shape (N, 9, 3)
        Rays of the nodes, of unit depth.
    away : ndarray, shape (N, 9, 2)
        Offsets of the nodes from the seed as an ideal lens would show them, px.
    """

    rays: SeedRays
    scale: int
    corner: IntArray
    offset: IntArray
    weights: FloatArray
    along_nodes: FloatArray
    node_ray: FloatArray
    away: FloatArray

    @classmethod
    def of(cls, rays: SeedRays, half_width: int, scale: int) -> WindowMapping:
        """Lay windows of so many pixels on each side around seeds."""
        corner = np.rint(rays.xy_px / scale).astype(np.int64)
        line = np.arange(-half_width, half_width + 1)
        y, x = (part.ravel() for part in np.meshgrid(line, line, indexing="ij"))
        ends = np.array([-half_width, 0, half_width])
        node_y, node_x = (part.ravel() for part in np.meshgrid(ends, ends, indexing="ij"))
        nodes = (corner[:, None, :] + np.column_stack([node_x, node_y])) * scale
        ray = unit_depth_rays(rays.first, nodes.reshape(-1, 2)).reshape(len(rays), 9, 3)
        pose = rays.first.camera_from_world.rotation[:2]
        focal = np.array([rays.first.matrix_px[0, 0], rays.first.matrix_px[1, 1]])
        away = (ray - rays.ray[:, None, :]) @ pose.T * focal
        value_x, slope_x = _parabolas(x / half_width)
        value_y, slope_y = _parabolas(y / half_width)
        at_nodes = np.flatnonzero(np.isin(x, ends) & np.isin(y, ends))
        # node number = 3 * row + column
        weights = (value_y[:, :, None] * value_x[:, None, :]).reshape(len(x), 9)
        by_x = (value_y[:, :, None] * slope_x[:, None, :]).reshape(len(x), 9)[at_nodes]
        by_y = (slope_y[:, :, None] * value_x[:, None, :]).reshape(len(x), 9)[at_nodes]
        return cls(
            rays,
            scale,
            corner,
            np.column_stack([x, y]),
            weights,
            np.stack([by_x, by_y]) / half_width,
            ray,
            away,
        )

    def select(self, rows: IntArray) -> WindowMapping:
        """Keep some windows."""
        return WindowMapping(
            self.rays.select(rows),
            self.scale,
            self.corner[rows],
            self.offset,
            self.weights,
            self.along_nodes,
            self.node_ray[rows],
            self.away[rows],
        )

    def apply(
        self, omega: FloatArray, slope: FloatArray, pace: FloatArray, beside: FloatArray
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Carry all pixels through planes.

        Parameters
        ----------
        omega : ndarray, shape (N,)
            Inverse depths at the seeds.
        slope : ndarray, shape (N, 2)
            Their change per ideal px.
        pace : ndarray, shape (N,)
            Way in the second view per omega, px.
        beside : ndarray, shape (N, 2)
            Unit vectors across the epipolar curves in the second view.

        Returns
        -------
        place : ndarray of float32, shape (N, 2, P)
            On the second view's level.
        back : ndarray of float32, shape (N, 2, P)
            Steps in the first view's level that lead to the same change of the grey value as a
            shift of 1 px along the epipolar curve.
        side : ndarray of float32, shape (N, 2, P)
            The same for a shift of 1 px across it.
        """
        depth = omega[:, None] + np.einsum("nkj,nj->nk", self.away, slope)
        depth = np.where(depth > 0, depth, np.nan)
        xyz = (self.rays.first.centre_mm + self.node_ray / depth[:, :, None]).reshape(-1, 3)
        camera = self.rays.second
        place = camera.project(xyz).reshape(-1, 9, 2)
        by_point = camera.project_jacobian(xyz).reshape(-1, 9, 2, 3)
        shift = -self.node_ray / (depth**2 * pace[:, None])[:, :, None]
        moved = np.einsum("nkij,nkj->nki", by_point, shift)
        # a pixel of the level is `scale` px
        place = place / self.scale
        warp = np.einsum("aqk,nki->nqia", self.along_nodes, place)
        back = _solved(warp, moved / self.scale)
        side = _solved(warp, np.broadcast_to(beside[:, None, :] / self.scale, moved.shape))
        # one product for all; float32 holds the places of 20 Mpx to a thousandth of a pixel
        nodes = np.concatenate([place, back, side], axis=2).transpose(0, 2, 1).astype(np.float32)
        # window by window: a large product would start threads for nine terms
        pixels = (nodes @ self.weights.T.astype(np.float32)).reshape(len(place), 3, 2, -1)
        return pixels[:, 0], pixels[:, 1], pixels[:, 2]


def _parabolas(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the parabolas through -1, 0, 1 at t and their slopes, shape (P, 3) each."""
    value = np.column_stack([t * (t - 1) / 2, 1 - t * t, t * (t + 1) / 2])
    slope = np.column_stack([t - 0.5, -2 * t, t + 0.5])
    return value, slope


def _solved(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Solve 2 x 2 systems; NaN where singular."""
    a, b, c, d = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 0], matrix[..., 1, 1]
    determinant = a * d - b * c
    determinant = np.where(np.abs(determinant) > 1e-9, determinant, np.nan)
    x = (d * vector[..., 0] - b * vector[..., 1]) / determinant
    y = (a * vector[..., 1] - c * vector[..., 0]) / determinant
    return np.stack([x, y], axis=-1)
