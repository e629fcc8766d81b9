"""Points every millimetre on the sharp edges of solids."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rendering.cameras import FloatArray
from rendering.solids import Solid

SHARP_DEG = 20.0
"""Least angle between the normals of both faces; facets of round bodies have a few degrees."""

SMOOTH_DEG = 15.0
"""Greatest turn between two pieces of one curve: facets of a bore, not the corner of a chamfer."""

SPACING_MM = 1.0
SHORT_MM = 0.5  # shorter edges have no point: the reader lets each point reach half the spacing


@dataclass(frozen=True, slots=True, eq=False)
class EdgePointTable:
    """Points on edges.

    Attributes
    ----------
    xyz_mm, direction : ndarray, shape (N, 3)
        World points and unit vectors along the edge.
    convex : ndarray of bool, shape (N,)
        Edge points outwards.
    """

    xyz_mm: FloatArray
    direction: FloatArray
    convex: NDArray[np.bool_]


def edge_points(solid: Solid) -> EdgePointTable:
    """Return points every millimetre, half a spacing from the ends of each edge.

    Parameters
    ----------
    solid : Solid
        A closed body; faces that share an edge share its corners.

    Returns
    -------
    EdgePointTable
        Points of all sharp edges.
    """
    parts = [_along(solid.vertices_mm, chain) for chain, _ in _chains(solid)]
    flags = [flag for _, flag in _chains(solid)]
    kept = [(part, flag) for part, flag in zip(parts, flags, strict=True) if part is not None]
    if not kept:
        return EdgePointTable(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.bool_))
    return EdgePointTable(
        np.concatenate([part[0] for part, _ in kept]),
        np.concatenate([part[1] for part, _ in kept]),
        np.concatenate([np.full(len(part[0]), flag) for part, flag in kept]),
    )


def _sharp(solid: Solid) -> dict[tuple[int, int], bool]:
    """Return sharp edges by their corners, with whether each is convex."""
    normals = solid.normals()
    sides: dict[tuple[int, int], list[tuple[int, int]]] = defaultdict(list)
    for number, face in enumerate(solid.faces):
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            sides[min(a, b), max(a, b)].append((number, 1 if a < b else -1))
    found = {}
    for (a, b), owners in sides.items():
        if len(owners) != 2:
            raise ValueError(f"{solid.name} is not closed: an edge has {len(owners)} faces")
        (one, _), (other, sense) = owners
        if normals[one] @ normals[other] < np.cos(np.deg2rad(SHARP_DEG)):
            along = sense * (solid.vertices_mm[b] - solid.vertices_mm[a])
            inward = np.cross(normals[other], along)  # within the other face
            found[a, b] = bool(inward @ normals[one] < 0)
    return found


def _chains(solid: Solid) -> list[tuple[list[int], bool]]:
    """Join sharp edges to curves: lists of corners; closed ones end with their first."""
    sharp = _sharp(solid)
    at: dict[int, list[int]] = defaultdict(list)
    for a, b in sharp:
        at[a].append(b)
        at[b].append(a)
    points = solid.vertices_mm
    left = dict.fromkeys(sorted(sharp))
    chains = []
    while left:
        a, b = next(iter(left))
        del left[a, b]
        flag = sharp[a, b]
        chain = [a, b]
        for _ in range(2):
            while True:
                before, here = chain[-2], chain[-1]
                ahead = [corner for corner in at[here] if corner != before]
                key = (min(here, *ahead), max(here, *ahead)) if len(ahead) == 1 else None
                if key not in left or sharp[key] != flag:
                    break
                if not _straight(points[before], points[here], points[ahead[0]]):
                    break
                del left[key]
                chain.append(ahead[0])
            chain.reverse()
        chains.append((chain, flag))
    return chains


def _straight(before: FloatArray, here: FloatArray, ahead: FloatArray) -> bool:
    one, other = here - before, ahead - here
    cos = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return bool(cos > np.cos(np.deg2rad(SMOOTH_DEG)))


def _along(points: FloatArray, chain: list[int]) -> tuple[FloatArray, FloatArray] | None:
    """Sample a chain of corners; None if it is too short."""
    corner = points[chain]
    step = np.diff(corner, axis=0)
    length = np.linalg.norm(step, axis=1)
    end = np.concatenate([[0.0], np.cumsum(length)])
    if end[-1] < SHORT_MM:
        return None
    count = max(round(end[-1] / SPACING_MM), 1)
    way = (np.arange(count) + 0.5) * end[-1] / count
    piece = np.clip(np.searchsorted(end, way, side="right") - 1, 0, len(step) - 1)
    unit = step / length[:, None]
    return corner[piece] + (way - end[piece])[:, None] * unit[piece], unit[piece]
