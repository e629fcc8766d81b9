"""Solids with flat faces: shapes, places, triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rendering.cameras import FloatArray

FACETS = 192
"""Of a full circle: at 20 mm radius they miss it by less than 3 um."""


@dataclass(frozen=True, slots=True)
class Finish:
    """How a surface looks.

    Attributes
    ----------
    grey : float
        Albedo, or reflectance of a metal.
    roughness : float
        0 is a mirror.
    metallic : bool
        Reflects instead of scattering.
    print_name : str
        Of `prints.PRINTS`; empty for plain.
    """

    grey: float = 0.6
    roughness: float = 0.8
    metallic: bool = False
    print_name: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A closed body.

    Attributes
    ----------
    name, kind : str
        For ``objects.json``.
    vertices_mm : ndarray, shape (N, 3)
        World corners.
    faces : tuple of tuple of int
        Flat polygons, counter-clockwise seen from outside.
    triangles : ndarray of int, shape (M, 3)
        Of all faces, one face after the other.
    finishes : tuple of Finish
        The first is of all faces but those of `marked`.
    marked : tuple of int
        Faces with the second finish.
    size : str
        In words, mm.
    """

    name: str
    kind: str
    vertices_mm: FloatArray
    faces: tuple[tuple[int, ...], ...]
    triangles: NDArray[np.int64]
    finishes: tuple[Finish, ...] = (Finish(),)
    marked: tuple[int, ...] = ()
    size: str = ""

    def normals(self) -> FloatArray:
        """Return outward unit normals of the faces, shape (F, 3): sums over their triangles."""
        a, b, c = self.vertices_mm[self.triangles].transpose(1, 0, 2)
        first = np.cumsum([0] + [len(face) - 2 for face in self.faces[:-1]])
        normal = np.add.reduceat(np.cross(b - a, c - a), first, axis=0)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))

    def moved(self, rotation: ArrayLike, shift_mm: ArrayLike) -> Solid:
        """Return it turned about the origin, then shifted."""
        turned = self.vertices_mm @ np.asarray(rotation).T + np.asarray(shift_mm)
        return replace(self, vertices_mm=turned)

    def finished(self, *finishes: Finish, facing: Sequence[ArrayLike] = ()) -> Solid:
        """Return it with other finishes; the second is of faces that face in given directions."""
        normal = self.normals()
        hit = [np.flatnonzero(normal @ (np.asarray(d) / np.linalg.norm(d)) > 0.9) for d in facing]
        marked = tuple(int(i) for i in np.unique(np.concatenate(hit))) if hit else ()
        return replace(self, finishes=finishes, marked=marked)


def convex(name: str, kind: str, vertices: ArrayLike, faces: Sequence[Sequence[int]]) -> Solid:
    """Build a solid of convex faces."""
    rings = tuple(tuple(int(i) for i in face) for face in faces)
    fans = [(ring[0], ring[i], ring[i + 1]) for ring in rings for i in range(1, len(ring) - 1)]
    points = np.array(vertices, np.float64)
    return Solid(name, kind, points, rings, np.array(fans, np.int64))


def tapered(
    name: str, kind: str, bottom: ArrayLike, top: ArrayLike, heights_mm: tuple[float, float]
) -> Solid:
    """Build a body between two convex outlines with equally many corners, counter-clockwise."""
    low, high = np.asarray(bottom, np.float64), np.asarray(top, np.float64)
    count = len(low)
    vertices = np.concatenate(
        [
            np.column_stack([low, np.full(count, heights_mm[0])]),
            np.column_stack([high, np.full(count, heights_mm[1])]),
        ]
    )
    sides = [(i, (i + 1) % count, count + (i + 1) % count, count + i) for i in range(count)]
    lids = [tuple(range(count))[::-1], tuple(range(count, 2 * count))]
    return convex(name, kind, vertices, [*lids, *sides])


def _rectangle(x_mm: float, y_mm: float) -> FloatArray:
    return np.array([[-x_mm, -y_mm], [x_mm, -y_mm], [x_mm, y_mm], [-x_mm, y_mm]]) / 2


def _circle(radius_mm: float, facets: int) -> FloatArray:
    turn = 2 * np.pi * np.arange(facets) / facets
    return radius_mm * np.column_stack([np.cos(turn), np.sin(turn)])


def _sized(solid: Solid, *lengths: float) -> Solid:
    return replace(solid, size=" x ".join(f"{length:g}" for length in lengths))


def box(name: str, x: float, y: float, z: float) -> Solid:
    """Build a box on the plane Z = 0, centred in X and Y; lengths in mm."""
    return _sized(tapered(name, "box", _rectangle(x, y), _rectangle(x, y), (0, z)), x, y, z)


def cylinder(name: str, radius: float, z: float, *, facets: int = FACETS) -> Solid:
    """Build an upright cylinder on Z = 0."""
    ring = _circle(radius, facets)
    return _sized(tapered(name, "cylinder", ring, ring, (0, z)), radius, z)


def cone_stump(name: str, radius: float, top_radius: float, z: float) -> Solid:
    """Build a cone without its tip on Z = 0."""
    rings = _circle(radius, FACETS), _circle(top_radius, FACETS)
    return _sized(tapered(name, "cone stump", *rings, (0, z)), radius, top_radius, z)


def prism(name: str, corners: int, radius: float, z: float) -> Solid:
    """Build an upright prism on Z = 0 over a regular polygon."""
    ring = _circle(radius, corners)
    return _sized(tapered(name, f"{corners}-sided prism", ring, ring, (0, z)), radius, z)


def pyramid_stump(name: str, x: float, y: float, z: float, top: float) -> Solid:
    """Build a truncated pyramid; `top` is the ratio of top to bottom lengths."""
    rings = _rectangle(x, y), _rectangle(x * top, y * top)
    return _sized(tapered(name, "truncated pyramid", *rings, (0, z)), x, y, z, top)


def wedge(name: str, x: float, y: float, z: float, low: float) -> Solid:
    """Build a box whose top falls along X from z to low."""
    solid = box(name, x, y, z)
    vertices = solid.vertices_mm.copy()
    vertices[[5, 6], 2] = low
    return _sized(convex(name, "wedge", vertices, solid.faces), x, y, z, low)


def roof(name: str, x: float, y: float, z: float, eaves: float, ridge: float) -> Solid:
    """Build a house: walls up to `eaves`, a ridge along X at z, `ridge` times as long as x."""
    end = ridge * x / 2
    ring = _rectangle(x, y)
    vertices = [[*p, 0] for p in ring] + [[*p, eaves] for p in ring] + [[-end, 0, z], [end, 0, z]]
    faces: list[tuple[int, ...]] = [(3, 2, 1, 0), (0, 1, 5, 4), (2, 3, 7, 6)]
    faces += [(4, 5, 9, 8), (6, 7, 8, 9)]
    if ridge == 1:
        faces += [(1, 2, 6, 9, 5), (3, 0, 4, 8, 7)]
    else:
        faces += [(1, 2, 6, 5), (3, 0, 4, 7), (5, 6, 9), (7, 4, 8)]
    return _sized(convex(name, "roof", vertices, faces), x, y, z, eaves, ridge)


def turn_z(angle_deg: float) -> FloatArray:
    """Return the rotation about Z."""
    return turn((0, 0, 1), angle_deg)


def turn(axis: ArrayLike, angle_deg: float) -> FloatArray:
    """Return the rotation about any axis (Rodrigues' formula)."""
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(angle_deg)
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def cut_below(solid: Solid, z_mm: float) -> Solid:
    """Cut off what lies below a plane of constant Z; the solid is convex.

    Parameters
    ----------
    solid : Solid
        A convex body.
    z_mm : float
        Height of the plane.

    Returns
    -------
    Solid
        What is above, with a flat face on the plane.
    """
    above = solid.vertices_mm[:, 2] > z_mm
    points: dict[tuple[int, int], FloatArray] = {}  # corners kept, and cut edges
    rings: dict[int, list[tuple[int, int]]] = {}
    for number, face in enumerate(solid.faces):
        ring = []
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            start, end = solid.vertices_mm[[min(a, b), max(a, b)]]
            if above[a]:
                ring.append((a, a))
                points[a, a] = solid.vertices_mm[a]
            if above[a] != above[b]:
                share = (z_mm - start[2]) / (end[2] - start[2])
                ring.append((min(a, b), max(a, b)))
                points[ring[-1]] = np.append((start + share * (end - start))[:2], z_mm)
        if ring:
            rings[number] = ring
    index = {key: place for place, key in enumerate(points)}
    faces = [[index[key] for key in ring] for ring in rings.values()]
    lid = [key for key in points if key[0] != key[1]]
    if lid:  # convex, seen from below
        flat = np.array([points[key][:2] for key in lid])
        x, y = (flat - flat.mean(axis=0)).T
        faces.append([index[lid[place]] for place in np.argsort(-np.arctan2(y, x))])
    new = convex(solid.name, solid.kind, list(points.values()), faces)
    marked = tuple(i for i, number in enumerate(rings) if number in solid.marked)
    return replace(new, finishes=solid.finishes, marked=marked, size=solid.size)
