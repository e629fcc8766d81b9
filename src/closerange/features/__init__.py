"""Pixels become points: targets, thresholds, borders, disc centres, labels; morphology, shapes.

Morphology's names may be taken from here; they are loaded when first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from closerange.features.edge_operators import (
        blur_minimum,
        dilation_residue_strength,
        edge_mask,
        erosion_residue_strength,
        pixel_noise,
    )
    from closerange.features.morphology import (
        closing,
        dilate,
        dilation_residue,
        erode,
        erosion_residue,
        opening,
    )
    from closerange.features.shape_recognition import ShapeHit, find_shapes, occurrences
    from closerange.features.shape_teaching import teach_shape
    from closerange.features.shapes import Shape
    from closerange.features.shapes_file import read_shapes, write_shapes
    from closerange.features.structuring import StructuringElement

_HOME = {
    "Shape": "shapes",
    "ShapeHit": "shape_recognition",
    "StructuringElement": "structuring",
    "blur_minimum": "edge_operators",
    "closing": "morphology",
    "dilate": "morphology",
    "dilation_residue": "morphology",
    "dilation_residue_strength": "edge_operators",
    "edge_mask": "edge_operators",
    "erode": "morphology",
    "erosion_residue": "morphology",
    "erosion_residue_strength": "edge_operators",
    "find_shapes": "shape_recognition",
    "occurrences": "shape_recognition",
    "opening": "morphology",
    "pixel_noise": "edge_operators",
    "read_shapes": "shapes_file",
    "teach_shape": "shape_teaching",
    "write_shapes": "shapes_file",
}

__all__ = [
    "Shape",
    "ShapeHit",
    "StructuringElement",
    "blur_minimum",
    "closing",
    "dilate",
    "dilation_residue",
    "dilation_residue_strength",
    "edge_mask",
    "erode",
    "erosion_residue",
    "erosion_residue_strength",
    "find_shapes",
    "occurrences",
    "opening",
    "pixel_noise",
    "read_shapes",
    "teach_shape",
    "write_shapes",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
