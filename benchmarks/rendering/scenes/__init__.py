"""The held-out scenes: defined here alone, with rigs unlike those of the shared scenes."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from rendering.scene import Scene
from rendering.scenes.clutter import clutter
from rendering.scenes.large import large
from rendering.scenes.metal import metal
from rendering.scenes.pins import pins
from rendering.scenes.texture import texture
from rendering.scenes.tumbled import tumbled, tumbled_again
from rendering.scenes.wedges import wedges

SCENES: Mapping[str, Callable[[], Scene]] = {
    "C_metal": metal,
    "C_pins": pins,
    "D_texture": texture,
    "D_clutter": clutter,
    "E_wedges": wedges,
    "F_large": large,
    "G_tumbled": tumbled,
    "H_tumbled": tumbled_again,
}
