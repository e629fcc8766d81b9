"""Printed faces beside plain ones."""

from __future__ import annotations

from rendering.cameras import View, looking
from rendering.placing import Place, around, put, standing
from rendering.scene import Light, Scene, ground
from rendering.sensor import Sensor
from rendering.solids import Finish, Solid, box, cylinder, pyramid_stump, wedge

TARGET: Place = (0.0, 0.0, -32.0)
SIZE_PX = (880, 660)
UP = (0, 0, 1)


def texture() -> Scene:
    """Return blocks and wedges with print, wood and speckle, and half of the ground mottled."""
    return Scene(
        name="D_texture",
        text=(
            "Blocks and wedges; some faces carry print, wood or speckle, others are plain; the "
            "left half of the work plane is mottled, the right half plain. Left camera rolled by "
            "22 deg, gamma 2.2."
        ),
        views=_views(),
        solids=_bodies(),
        grounds=(
            ground(Finish(print_name="cloth"), right_mm=8.0),
            ground(Finish(0.2), left_mm=8.0),
        ),
        lights=(
            Light((-400, -450, 800), (400, 300), 7.0),
            Light((550, 250, 750), (300, 300), 6.0),
        ),
        heights_mm=(-53, 5),
        seed=31,
        gains=(1.0, 1.2),
        bright=0.7,
        sensor=Sensor(gamma=2.2),
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            3300.0,
            centre_mm=around(810, -12, -7, TARGET),
            target_mm=(-1, 2, -32),
            roll_deg=22,
            off_px=(12.1, -8.8),
            brown=(-0.48, 0.9, 0.0013, 0.0006, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            3560.0,
            centre_mm=around(890, 9, -4, TARGET),
            target_mm=(2, 1, -32),
            roll_deg=-5,
            off_px=(-6.6, -10.4),
            brown=(-0.66, 1.7, -0.0008, -0.0011, 0.0),
        ),
    )


def _bodies() -> tuple[Solid, ...]:
    plain, dim = Finish(0.62), Finish(0.42)
    label, wood = Finish(print_name="label"), Finish(print_name="wood")
    speckle = Finish(print_name="speckle")
    carton = box("carton", 46, 32, 42).finished(plain, label, facing=[UP, (0, -1, 0)])
    beam = box("beam", 58, 24, 22).finished(plain, wood, facing=[UP, (0, 1, 0), (0, -1, 0)])
    ramp = wedge("speckled_ramp", 44, 34, 34, 8).finished(plain, speckle, facing=[(26, 0, 44)])
    disc = cylinder("disc", 15, 18).finished(dim, speckle, facing=[UP])
    stump = pyramid_stump("stump", 32, 32, 26, 0.5).finished(plain, wood, facing=[(26, 0, 8)])
    return (
        put(carton, -50, 30, 12),
        put(beam, -44, -32, -18),
        put(ramp, 8, 2, 48),
        put(disc, 6, 47, 0),
        put(stump, 58, -40, 20),
        standing(box("plain_block", 36, 26, 32), 58, 34, -28, dim),
        standing(wedge("plain_ramp", 38, 28, 26, 5), 6, -46, 170, plain),
    )
