"""Five megapixels."""

from __future__ import annotations

from rendering.cameras import View, looking
from rendering.placing import Place, around, put, standing, tilted
from rendering.scene import Light, Scene, ground
from rendering.scenes.metal import bracket
from rendering.solids import Finish, Solid, box, cylinder, pyramid_stump, roof, wedge

TARGET: Place = (0.0, 0.0, -10.0)
SIZE_PX = (2448, 2048)


def large() -> Scene:
    """Return a few large plain parts for the cost of many pixels."""
    return Scene(
        name="F_large",
        text=(
            "A few plain blocks and parts of 60 to 150 mm in images of 2448 x 2048 px (4.7 px per "
            "mm as elsewhere, so the field is half a metre). Right camera rolled by -11 deg."
        ),
        views=_views(),
        solids=_bodies(),
        grounds=(ground(Finish(0.13)),),
        lights=(
            Light((-900, 700, 1500), (700, 700), 7.0),
            Light((1000, -300, 1600), (600, 600), 5.0),
        ),
        heights_mm=(-55, 80),
        seed=71,
        gains=(1.0, 0.9),
        samples=2,
        fineness=2,
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            7100.0,
            centre_mm=around(1500, -10, 5, TARGET),
            target_mm=(3, 2, -10),
            roll_deg=5,
            off_px=(21.3, -33.7),
            brown=(-0.16, 0.1, 0.0004, -0.0003, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            6850.0,
            centre_mm=around(1430, 11, 8, TARGET),
            target_mm=(-4, 0, -10),
            roll_deg=-11,
            off_px=(-17.4, 25.2),
            brown=(-0.13, 0.2, -0.0003, 0.0005, 0.0),
        ),
    )


def _bodies() -> tuple[Solid, ...]:
    return (
        standing(box("block_high", 90, 64, 112), -120, 80, 18, Finish(0.6)),
        standing(box("block_low", 130, 70, 46), 95, -95, -24, Finish(0.5)),
        standing(wedge("ramp", 110, 80, 84, 20), 100, 85, 40, Finish(0.66)),
        standing(cylinder("drum", 42, 70), -25, -60, 0, Finish(0.56)),
        standing(roof("house", 96, 60, 66, 30, 0.6), -140, -90, 65, Finish(0.45)),
        standing(pyramid_stump("pyramid", 70, 70, 60, 0.4), 5, 45, 10, Finish(0.7)),
        put(bracket("bracket", 1.7).finished(Finish(0.52)), -10, 130, -35),
        tilted(box("plate", 100, 70, 8), (10, -140, -42), (1, 0.2, 0), 28, Finish(0.62)),
    )
