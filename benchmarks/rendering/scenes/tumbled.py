"""Other tumbled solids than those of the clutter, on a plain ground, for other cameras."""

from __future__ import annotations

from rendering.cameras import View, looking
from rendering.placing import Place, around
from rendering.scene import Light, Scene, ground
from rendering.scenes.clutter import bodies
from rendering.solids import Finish

TARGET: Place = (0.0, 0.0, -36.0)
SIZE_PX = (768, 600)


def tumbled() -> Scene:
    """Return tilted solids on a plain ground; a rule was chosen with their help."""
    return _scene("G_tumbled", 14, bodies_seed=143, seed=141, gains=(0.9, 1.0))


def tumbled_again() -> Scene:
    """Return others for the same cameras; judged once, after the last change of the matcher."""
    return _scene("H_tumbled", 16, bodies_seed=777, seed=778, gains=(1.0, 0.85))


def _scene(
    name: str, count: int, *, bodies_seed: int, seed: int, gains: tuple[float, float]
) -> Scene:
    return Scene(
        name=name,
        text=(
            f"{count} different small solids at random tilts, cut off by the work plane, on a "
            "plain ground. Left camera rolled by -12 deg, right by 9 deg."
        ),
        views=_views(),
        solids=bodies(bodies_seed, count),
        grounds=(ground(Finish(0.16)),),
        lights=(
            Light((500, 350, 750), (350, 350), 8.0),
            Light((-450, -400, 850), (300, 300), 5.0),
        ),
        heights_mm=(-53, 0),
        seed=seed,
        gains=gains,
        bright=0.85,
    )


def _views() -> tuple[View, ...]:
    return (
        looking(
            "left",
            SIZE_PX,
            3300.0,
            centre_mm=around(820, -9, -6, TARGET),
            target_mm=(-1, 1, -36),
            roll_deg=-12,
            off_px=(-6.1, 3.7),
            brown=(-0.4, 0.7, 0.0007, -0.0011, 0.0),
        ),
        looking(
            "right",
            SIZE_PX,
            3050.0,
            centre_mm=around(760, 13, 4, TARGET),
            target_mm=(1, 2, -36),
            roll_deg=9,
            off_px=(8.8, -7.4),
            brown=(-0.45, 0.9, -0.0008, 0.0006, 0.0),
        ),
    )
