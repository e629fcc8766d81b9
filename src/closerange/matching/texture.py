"""Where a scene is textured, and whether edges or windows are to be believed there."""

from __future__ import annotations

import cv2
import numpy as np

from closerange.features.edges import EdgePoints
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite

WINDOW_PX = 31
"""Side of the square in which edge points are counted."""

CORNER_LINES = 3.0
"""So many straight edges run through that square at a corner of a part; with more of them a window
can tell where an edge is that the edges around it do not."""

TEXTURE_LINES = 5.0
"""So many through that square are texture, if they go several ways: candidates are everywhere, and
a window of grey values is the better witness."""

MOSTLY_TEXTURE = 0.3
"""Share of an image's edge points on texture above which the scene is taken for a textured one.
Plain parts have less than a tenth there, a speckled plate or a plant two thirds and more."""

ONE_WAY = 0.6
"""Length of the mean of the doubled directions, from 0 (all ways) to 1 (parallel), above which
edges are taken for parallel."""

ENOUGH = 1 / 8
"""Share of the points on edges that must lie on texture before any window is looked at. Of plain
parts it is up to a twentieth, of machined metal a fourteenth: there windows that straddle an edge
would be believed too often, and take more time than all edges together."""

FEW = 0.1
"""Points per edge point of a textured scene below which its edges are not matched: a hundred points
on speckle are no reason to match a hundred thousand edges."""


def texture_lines(edges: EdgePoints) -> FloatArray:
    """Return how many straight edges would make as much texture as there is around each point.

    Texture is where many edges of many directions lie close together. Coils, teeth and other
    parallel edges have one direction and count as none.

    Parameters
    ----------
    edges : EdgePoints
        N points.

    Returns
    -------
    ndarray, shape (N,)
        Edge points in a square of `WINDOW_PX` per side of it; 0 where they are parallel.
    """
    width, height = edges.size_px
    column, row = np.rint(edges.xy_px).astype(np.int64).T
    twice = 2 * np.arctan2(edges.normal[:, 1], edges.normal[:, 0])
    sums = []
    for value in (np.ones(len(edges)), np.cos(twice), np.sin(twice)):
        image = np.zeros((height, width), dtype=np.float32)
        np.add.at(image, (row, column), value.astype(np.float32))
        window = (WINDOW_PX, WINDOW_PX)
        summed = cv2.boxFilter(image, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        sums.append(summed[row, column])
    one_way = np.hypot(sums[1], sums[2]) > ONE_WAY * sums[0]
    return np.where(one_way, 0.0, sums[0] / WINDOW_PX)


def mostly_texture(lines: FloatArray) -> bool:
    """Tell whether so much of a scene is textured that plain surfaces are the exception.

    Parameters
    ----------
    lines : ndarray, shape (N,)
        What `texture_lines` says of all edge points of an image.
    """
    return bool(len(lines)) and float((lines > TEXTURE_LINES).mean()) > MOSTLY_TEXTURE


def wants_window(lines: FloatArray, flags: IntArray, *, textured: bool) -> BoolArray:
    """Mark points on edges whose window is worth a look, shape (N,).

    Parameters
    ----------
    lines : ndarray, shape (N,)
        Texture around each.
    flags : ndarray of int, shape (N,)
        Of their matches by edges.
    textured : bool
        Whether the scene is mostly textured.
    """
    on_texture = lines > TEXTURE_LINES
    wanted = on_texture | ((flags != 0) & (textured | (lines > CORNER_LINES)))
    return np.asarray(wanted & (on_texture.sum() >= ENOUGH * len(lines)))


def believes_window(
    lines: FloatArray,
    by_edge: tuple[IntArray, FloatArray],
    by_window: tuple[IntArray, FloatArray],
) -> BoolArray:
    """Mark points whose window is to be believed rather than their edge.

    On texture what the window says counts if nothing speaks against it, elsewhere what the edge
    says. Where both have their doubts the window is the better guess on texture; elsewhere a match
    that does not return is worse than any other. A lone edge along the epipolar curve is all that
    its window sees too: it cannot know better.

    Parameters
    ----------
    lines : ndarray, shape (N,)
        Texture around each point.
    by_edge, by_window : tuple of two ndarrays
        Flags, shape (N,), and places, shape (N, 2), that both have found.

    Returns
    -------
    ndarray of bool, shape (N,)
    """
    edge_kept, window_kept = by_edge[0] == 0, by_window[0] == 0
    lost = by_edge[0] & int(Flag.inconsistent) != 0
    gone = by_window[0] & int(Flag.inconsistent) != 0
    doubtful = ~edge_kept & ~window_kept & all_finite(by_window[1], 1)
    doubtful &= lost | ~gone | ~all_finite(by_edge[1], 1) | (lines > TEXTURE_LINES)
    lone = (by_edge[0] & int(Flag.aperture) != 0) & (lines < 1.0)
    certain = window_kept & (~edge_kept | (lines > TEXTURE_LINES))
    return np.asarray((certain | doubtful) & ~lone)
