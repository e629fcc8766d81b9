"""What a scene consists of."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rendering.cameras import View
from rendering.sensor import Sensor
from rendering.solids import Finish, Solid, convex
from rendering.truth import Surfaces

GROUND_Z_MM = -50.0
FAR_MM = 1000.0
"""Of the border of the work plane from the middle: beyond all images, before all cameras."""


@dataclass(frozen=True, slots=True)
class Light:
    """A rectangular light.

    Attributes
    ----------
    centre_mm, target_mm : tuple of float
        Where it is and what it faces.
    size_mm : tuple of float
        Of both sides.
    radiance : float
        Relative to that of the other lights and of the surroundings.
    """

    centre_mm: tuple[float, float, float]
    size_mm: tuple[float, float]
    radiance: float
    target_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything that is rendered.

    Attributes
    ----------
    name, text : str
        Of the folder; what there is to see.
    views : tuple of View
        The first two are left and right.
    solids, grounds : tuple of Solid
        Bodies; faces of the work plane.
    lights : tuple of Light
        And `ambient`, the light of the surroundings.
    heights_mm : tuple of float
        What to search between, for the judge's ``--z``.
    gains : tuple of float
        Of each camera, relative.
    bright : float
        Share of full scale that the brightest hundredth of the first image reaches.
    samples, fineness : int
        Paths per fine pixel, fine pixels per pixel (along one side).
    seed : int
        Of paths and noise.
    """

    name: str
    text: str
    views: tuple[View, ...]
    solids: tuple[Solid, ...]
    grounds: tuple[Solid, ...]
    lights: tuple[Light, ...]
    heights_mm: tuple[float, float]
    seed: int
    ambient: float = 0.15
    gains: tuple[float, ...] = (1.0, 1.0, 1.0)
    bright: float = 0.8
    samples: int = 4
    fineness: int = 3
    sensor: Sensor = field(default_factory=Sensor)

    def surfaces(self) -> Surfaces:
        """Return all triangles with the number of their object."""
        bodies = [*((0, ground) for ground in self.grounds), *enumerate(self.solids, start=1)]
        return Surfaces(
            np.concatenate([body.vertices_mm[body.triangles] for _, body in bodies]),
            np.concatenate([np.full(len(body.triangles), owner) for owner, body in bodies]),
        )


def ground(finish: Finish, *, left_mm: float = -FAR_MM, right_mm: float = FAR_MM) -> Solid:
    """Build a strip of the work plane between two X."""
    corners = [(left_mm, -FAR_MM), (right_mm, -FAR_MM), (right_mm, FAR_MM), (left_mm, FAR_MM)]
    flat = [(x, y, GROUND_Z_MM) for x, y in corners]
    return convex("work plane", "plane", flat, [(0, 1, 2, 3)]).finished(finish)
