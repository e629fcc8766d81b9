"""Repeated structure."""

from __future__ import annotations

import numpy as np

from rendering.cameras import View, looking
from rendering.placing import Place, around, standing
from rendering.scene import GROUND_Z_MM, Light, Scene, ground
from rendering.sensor import Sensor
from rendering.solids import Finish, Solid, box, cylinder, turn_z

TARGET: Place = (0.0, 0.0, -35.0)
SIZE_PX = (800, 600)


def pins() -> Scene:
    """Return a plate with a regular grid of equal pins."""
    return Scene(
        name="C_pins",
        text=(
            "A plate with a regular 16 mm grid of 30 equal round pins (diameter 6 mm) and five "
            "square ones, 14, 18 or 24 mm high: repeated structure. Right camera rolled by 12 deg, "
            "gamma 1.8."
        ),
        views=_views(),
        solids=_bodies(),
        grounds=(ground(Finish(0.1)),),
        lights=(
            Light((-350, -500, 800), (300, 300), 8.0),
            Light((500, 500, 700), (400, 250), 5.0),
        ),
        heights_mm=(-53, -10),
        seed=22,
        gains=(1.0, 1.15),
        bright=0.7,
        sensor=Sensor(gamma=1.8),
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            2900.0,
            centre_mm=around(720, -13, 6, TARGET),
            target_mm=(2, 0, -35),
            roll_deg=-3,
            off_px=(-11.2, 6.7),
            brown=(-0.38, 0.5, 0.0008, 0.0012, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            3250.0,
            centre_mm=around(800, 15, 9, TARGET),
            target_mm=(-1, 1, -35),
            roll_deg=12,
            off_px=(8.4, 9.9),
            brown=(-0.62, 1.1, -0.0012, 0.0007, 0.0),
        ),
    )


def _bodies() -> tuple[Solid, ...]:
    plate = standing(box("plate", 126, 92, 8), 0, 0, 4, Finish(0.34))
    solids = [plate]
    heights = (14.0, 18.0, 24.0)
    rng = np.random.default_rng(21)
    for row in range(5):
        for column in range(7):
            z = heights[int(rng.choice(3, p=(0.6, 0.25, 0.15)))]
            x, y = 16.0 * (column - 3), 16.0 * (row - 2)
            name = f"pin_{row}{column}"
            square = (row, column) in {(0, 2), (1, 5), (3, 1), (4, 4), (2, 3)}
            pin = box(name, 6, 6, z) if square else cylinder(name, 3.0, z, facets=96)
            turned = turn_z(4) @ [x, y, 0.0]
            on_plate = pin.moved(turn_z(4), np.add(turned, (0, 0, GROUND_Z_MM + 8)))
            solids.append(on_plate.finished(Finish(0.66)))
    return tuple(solids)
