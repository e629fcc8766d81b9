"""Where solids and cameras are put."""

from __future__ import annotations

import numpy as np

from rendering.cameras import FloatArray
from rendering.scene import GROUND_Z_MM
from rendering.solids import Finish, Solid, cut_below, turn, turn_z

Place = tuple[float, float, float]
DIRECTIONS = 60  # tried besides the normals of faces
MANY_FACES = 20


def around(distance_mm: float, right_deg: float, up_deg: float, target: Place) -> Place:
    """Return a place above a target, leaning to +X and +Y by two angles."""
    right, up = np.tan(np.deg2rad([right_deg, up_deg]))
    way = np.array([right, up, 1.0]) / np.linalg.norm([right, up, 1.0])
    x, y, z = (np.asarray(target) + distance_mm * way).tolist()
    return x, y, z


def standing(solid: Solid, x: float, y: float, angle_deg: float, finish: Finish) -> Solid:
    """Put a plain solid on the work plane."""
    return put(solid.finished(finish), x, y, angle_deg)


def put(solid: Solid, x: float, y: float, angle_deg: float) -> Solid:
    """Put a solid on the work plane with the finishes that it has."""
    return solid.moved(turn_z(angle_deg), (x, y, GROUND_Z_MM))


def tilted(solid: Solid, place: Place, axis: Place, angle_deg: float, finish: Finish) -> Solid:
    """Tilt a convex solid about an axis; what is below the work plane is cut off."""
    return cut_below(solid.moved(turn(axis, angle_deg), place).finished(finish), GROUND_Z_MM)


def apart(one: Solid, other: Solid, gap_mm: float) -> bool:
    """Tell whether some plane keeps two convex solids apart; False if none was found."""
    axes = np.eye(3)
    if _keeps_apart(np.concatenate([axes, -axes]), one, other, gap_mm):
        return True
    way = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    # the many faces of round bodies are as good as directions at random
    flat = [body.normals() for body in (one, other) if len(body.faces) < MANY_FACES]
    way = np.concatenate([way, *flat])
    return _keeps_apart(np.concatenate([way, -way]), one, other, gap_mm)


def _keeps_apart(way: FloatArray, one: Solid, other: Solid, gap_mm: float) -> bool:
    ahead = (one.vertices_mm @ way.T).max(axis=0) + gap_mm
    return bool((ahead < (other.vertices_mm @ way.T).min(axis=0)).any())
