"""Many small solids at random tilts."""

from __future__ import annotations

import numpy as np

from rendering.cameras import View, looking
from rendering.placing import Place, apart, around
from rendering.scene import GROUND_Z_MM, Light, Scene, ground
from rendering.solids import (
    Finish,
    Solid,
    box,
    cone_stump,
    cut_below,
    cylinder,
    prism,
    pyramid_stump,
    roof,
    turn,
    turn_z,
    wedge,
)

TARGET: Place = (0.0, 0.0, -36.0)
SIZE_PX = (800, 640)
COUNT = 22
TRIES = 5000
HALF_MM = (64.0, 46.0)  # of the ground that is strewn
GAP_MM = 0.4


def clutter() -> Scene:
    """Return solids that stick out of a striped ground in all directions."""
    return Scene(
        name="D_clutter",
        text=(
            f"{COUNT} different small solids at random tilts, cut off by the work plane and partly "
            "before each other, on a striped ground. Right camera rolled by 28 deg."
        ),
        views=_views(),
        solids=bodies(43, COUNT),
        grounds=(ground(Finish(print_name="stripes")),),
        lights=(
            Light((-450, 400, 750), (350, 350), 7.0),
            Light((450, 450, 850), (250, 250), 5.0),
            Light((0, -700, 700), (300, 200), 4.0),
        ),
        heights_mm=(-53, 0),
        seed=41,
        gains=(1.0, 0.75),
        bright=0.85,
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            3150.0,
            centre_mm=around(740, -16, 3, TARGET),
            target_mm=(1, 0, -36),
            roll_deg=-6,
            off_px=(5.2, 9.1),
            brown=(-0.5, 1.0, -0.0009, 0.0015, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            2600.0,
            centre_mm=around(660, 12, 8, TARGET),
            target_mm=(-2, -1, -36),
            roll_deg=28,
            off_px=(-13.3, 16.3),
            brown=(-0.33, 0.3, 0.0012, 0.0004, 0.0),
        ),
    )


def bodies(seed: int, count: int) -> tuple[Solid, ...]:
    """Return solids at random places and tilts, none in another.

    Raises
    ------
    ValueError
        If there is no room for so many.
    """
    rng = np.random.default_rng(seed)
    placed: list[Solid] = []
    for _ in range(TRIES):
        if len(placed) == count:
            return tuple(placed)
        body = _strewn(len(placed) + 1, rng)
        if all(apart(body, other, GAP_MM) for other in placed):
            placed.append(body)
    raise ValueError(f"only {len(placed)} of {count} solids found room; enlarge HALF_MM")


def _strewn(number: int, rng: np.random.Generator) -> Solid:
    """Return a solid at a random place and tilt that reaches a little below the ground."""
    shape = _shape(f"part_{number:02d}", number, rng)
    across = rng.uniform(0, 360)
    rotation = turn((np.cos(across), np.sin(across), 0), rng.uniform(5, 60))
    shape = shape.moved(rotation @ turn_z(rng.uniform(0, 360)), (0, 0, 0))
    x, y = rng.uniform(-1, 1, 2) * HALF_MM
    z = GROUND_Z_MM - rng.uniform(1, 5) - shape.vertices_mm[:, 2].min()
    body = shape.moved(np.eye(3), (x, y, z)).finished(Finish(float(rng.uniform(0.3, 0.75))))
    return cut_below(body, GROUND_Z_MM)


def _shape(name: str, number: int, rng: np.random.Generator) -> Solid:
    """Return the next kind of solid with random lengths."""
    a, b = rng.uniform(13, 30), rng.uniform(10, 22)
    z = rng.uniform(14, 34)
    kinds = (
        lambda: box(name, a, b, z),
        lambda: wedge(name, a, b, z, 0.3 * z),
        lambda: cylinder(name, b / 2, z),
        lambda: prism(name, 6, b / 2 + 2, z),
        lambda: pyramid_stump(name, a, b, z, 0.5),
        lambda: roof(name, a, b, z, 0.5 * z, 0.6),
        lambda: cone_stump(name, b / 2 + 2, b / 4, z),
        lambda: prism(name, 3, b / 2 + 3, z),
        lambda: box(name, 1.3 * a, b, 5),
    )
    return kinds[number % len(kinds)]()
