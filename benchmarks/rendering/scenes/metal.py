"""Milled metal."""

from __future__ import annotations

from rendering.cameras import View, looking
from rendering.placing import Place, around, put
from rendering.scene import Light, Scene, ground
from rendering.solids import Finish, Solid, box, cylinder, prism, turn

TARGET: Place = (0.0, 0.0, -36.0)
SIZE_PX = (1000, 800)
CHAMFER_MM = 0.3
FACETS = 96  # of bores


def metal() -> Scene:
    """Return milled parts with pockets and bores under strip lights."""
    return Scene(
        name="C_metal",
        text=(
            "Five milled metal parts (bracket, plate with pocket and bores, flange, nut, V-block) "
            f"with {CHAMFER_MM:g} mm chamfers under strip lights; the reflections differ between "
            "the views. Left camera rolled by -14 deg, 35 deg between the axes."
        ),
        views=_views(),
        solids=_bodies(),
        grounds=(ground(Finish(0.3, 0.7)),),
        lights=(
            Light((-330, 60, 700), (90, 1200), 9.0),
            Light((60, 420, 760), (1200, 90), 9.0),
            Light((380, -100, 720), (90, 1000), 7.0),
            Light((0, 0, 1300), (900, 900), 1.2),
        ),
        heights_mm=(-53, 0),
        seed=61,
        ambient=0.8,
        gains=(1.0, 1.25),
        bright=0.75,
        samples=4,
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            3050.0,
            centre_mm=around(660, -18, -5, TARGET),
            target_mm=(2, -1, -36),
            roll_deg=-14,
            off_px=(14.7, -11.9),
            brown=(-0.3, 0.2, 0.0007, -0.0012, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            3320.0,
            centre_mm=around(720, 17, 2, TARGET),
            target_mm=(-1, 0, -36),
            roll_deg=3,
            off_px=(-7.1, 10.6),
            brown=(-0.4, 0.8, -0.001, 0.0008, 0.0),
        ),
    )


def _bodies() -> tuple[Solid, ...]:
    finishes = [Finish(grey, rough, metallic=True) for grey, rough in _LOOKS]
    parts = (bracket("bracket"), plate("plate"), flange("flange"), nut("nut"), v_block("v_block"))
    return tuple(
        put(part.finished(finish), *place)
        for part, finish, place in zip(parts, finishes, _PLACES, strict=True)
    )


_LOOKS = ((0.62, 0.32), (0.7, 0.38), (0.55, 0.28), (0.6, 0.3), (0.66, 0.42))
_PLACES = (
    (-50.0, 26.0, 24.0),
    (40.0, 28.0, -14.0),
    (-38.0, -38.0, 0.0),
    (12.0, -14.0, 10.0),
    (50.0, -36.0, 33.0),
)


def bracket(name: str, scale: float = 1.0) -> Solid:
    """Build an angle with two bores in its foot and one in its wall."""
    from rendering.blender import carved, chamfered  # noqa: PLC0415

    s = scale
    tools = [box("space", 60 * s, 60 * s, 60 * s).moved(turn((0, 0, 1), 0), (10 * s, 0, 10 * s))]
    for side in (-9, 9):
        bore = cylinder("bore", 4 * s, 40 * s, facets=FACETS)
        tools.append(bore.moved(turn((0, 0, 1), 0), (10 * s, side * s, -10 * s)))
    across = cylinder("across", 6 * s, 60 * s, facets=FACETS)
    tools.append(across.moved(turn((0, 1, 0), 90), (-40 * s, 0, 24 * s)))
    return chamfered(carved(box(name, 56 * s, 36 * s, 38 * s), tools), CHAMFER_MM)


def plate(name: str) -> Solid:
    """Build a plate with a pocket, a bore within, and four small bores at its corners."""
    from rendering.blender import carved, chamfered  # noqa: PLC0415

    flat = turn((0, 0, 1), 0)
    tools = [box("pocket", 34, 22, 20).moved(flat, (0, 0, 7))]
    tools.append(cylinder("through", 6, 40, facets=FACETS).moved(flat, (5, 0, -10)))
    bore = cylinder("bore", 2.6, 40, facets=FACETS)
    tools += [bore.moved(flat, (x, y, -10)) for x in (-22, 22) for y in (-16, 16)]
    return chamfered(carved(box(name, 56, 44, 16), tools), CHAMFER_MM)


def flange(name: str) -> Solid:
    """Build a flange with a boss, a central bore and three bores around."""
    from rendering.blender import carved, chamfered, joined  # noqa: PLC0415

    flat = turn((0, 0, 1), 0)
    body = joined(cylinder(name, 23, 9), [cylinder("boss", 11, 27)])
    tools = [cylinder("through", 6, 60, facets=FACETS).moved(flat, (0, 0, -10))]
    for angle in (20, 140, 260):
        bore = cylinder("bore", 2.8, 60, facets=FACETS).moved(flat, (17, 0, -10))
        tools.append(bore.moved(turn((0, 0, 1), angle), (0, 0, 0)))
    return chamfered(carved(body, tools), CHAMFER_MM)


def nut(name: str) -> Solid:
    """Build a six-sided nut."""
    from rendering.blender import carved, chamfered  # noqa: PLC0415

    bore = cylinder("through", 7, 60, facets=FACETS).moved(turn((0, 0, 1), 0), (0, 0, -10))
    return chamfered(carved(prism(name, 6, 14, 12), [bore]), CHAMFER_MM)


def v_block(name: str) -> Solid:
    """Build a block with a V-shaped groove and a slot."""
    from rendering.blender import carved, chamfered  # noqa: PLC0415

    groove = box("groove", 80, 22, 22).moved(turn((1, 0, 0), 45), (0, 0, 14))
    slot = box("slot", 80, 4, 20).moved(turn((0, 0, 1), 0), (0, 0, 12))
    return chamfered(carved(box(name, 46, 36, 28), [groove, slot]), CHAMFER_MM)
