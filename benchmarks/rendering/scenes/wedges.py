"""Slanted faces."""

from __future__ import annotations

import numpy as np

from rendering.cameras import View, looking
from rendering.placing import Place, around, standing, tilted
from rendering.scene import Light, Scene, ground
from rendering.solids import Finish, Solid, box, pyramid_stump, roof, tapered, wedge

TARGET: Place = (0.0, 0.0, -30.0)
SIZE_PX = (720, 576)


def wedges() -> Scene:
    """Return slanted faces only; one camera above the other, a third beside them."""
    return Scene(
        name="E_wedges",
        text=(
            "Plain matt wedges, roofs, truncated pyramids and tilted plates on a plain dark plane: "
            "nearly all faces and edges are slanted. The right camera is below the left one as "
            "seen in the image, rolled by -17 deg; a third camera to the right."
        ),
        views=_views(),
        solids=_bodies(),
        grounds=(ground(Finish(0.12)),),
        lights=(
            Light((-500, 350, 700), (350, 350), 9.0),
            Light((600, -200, 800), (300, 300), 4.0),
        ),
        heights_mm=(-53, 0),
        seed=51,
        gains=(1.0, 0.8, 1.1),
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            2650.0,
            centre_mm=around(690, 3, 12, TARGET),
            target_mm=(1, -1, -30),
            roll_deg=4,
            off_px=(7.3, -5.1),
            brown=(-0.55, 1.4, 0.0011, -0.0016, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            2380.0,
            centre_mm=around(640, -2, -14, TARGET),
            target_mm=(-2, 2, -30),
            roll_deg=-17,
            off_px=(-9.6, 4.2),
            brown=(-0.42, 0.6, -0.0014, 0.0009, 0.0),
        ),
        looking(
            "third",
            SIZE_PX,
            2500.0,
            centre_mm=around(660, 17, 2, TARGET),
            target_mm=(0, 0, -30),
            roll_deg=9,
            off_px=(3.0, 2.0),
            brown=(-0.5, 0.9, 0.0, 0.0, 0.0),
        ),
    )


def _bodies() -> tuple[Solid, ...]:
    five = 2 * np.pi * np.arange(5) / 5
    ring = np.column_stack([np.cos(five), np.sin(five)])
    tower = tapered("tower", "5-sided stump", 17 * ring, 9 * ring, (0, 41))
    return (
        standing(roof("hip", 44, 28, 33, 13, 0.5), -46, 31, 25, Finish(0.62)),
        standing(roof("gable", 38, 25, 27, 10, 1.0), 44, -33, -22, Finish(0.5)),
        standing(wedge("ramp_high", 42, 26, 37, 7), 3, 33, -33, Finish(0.7)),
        standing(wedge("ramp_low", 34, 34, 21, 4), -53, -24, 62, Finish(0.45)),
        standing(pyramid_stump("pyramid", 34, 34, 29, 0.45), -8, -10, 14, Finish(0.58)),
        standing(tower, 52, 33, 8, Finish(0.52)),
        tilted(box("plate_a", 46, 30, 4), (-12, -47, -46), (0.9, 0.35, 0), 31, Finish(0.66)),
        tilted(box("plate_b", 30, 26, 3), (42, 2, -45), (0.2, 1, 0), 38, Finish(0.4)),
    )
