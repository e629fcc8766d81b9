"""Close-range 3-D position sensing with two or more ordinary cameras placed anywhere.

Ten lines from images to positions::

    import closerange as cr

    points = cr.detect("calibration/left", target="plate.toml", camera="left")
    points += cr.detect("calibration/right", target="plate.toml", camera="right")
    rig = cr.calibrate(points, control="control.csv")
    print(rig.trust)
    matches = cr.match(rig, {"left": "part_l.png", "right": "part_r.png"}, edges=True)
    positions = cr.measure(rig, matches)
    positions.to_csv("part.csv")

The verbs are those of the command line. Names are loaded when first used, so that
``import closerange`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from closerange.errors import CloseRangeError, CloseRangeWarning
from closerange.flags import Flag
from closerange.version import __version__

if TYPE_CHECKING:
    from closerange.features.control import ControlPoints, read_control
    from closerange.features.image_points import ImagePoints
    from closerange.features.points_table import read_points
    from closerange.features.target import Target
    from closerange.images.frame import Frame
    from closerange.position.positions import Positions
    from closerange.position.positions_table import read_positions
    from closerange.rig.camera import Camera
    from closerange.rig.rig import Rig
    from closerange.rig.rig_file import read_rig
    from closerange.verification.acceptance import AcceptanceReport
    from closerange.workflows.calibrate import calibrate
    from closerange.workflows.demo import demo
    from closerange.workflows.detect import detect
    from closerange.workflows.match import match
    from closerange.workflows.measure import measure
    from closerange.workflows.report import report
    from closerange.workflows.run import run
    from closerange.workflows.verify import verify
    from closerange.workflows.volume import volume

_HOME = {
    "AcceptanceReport": "verification.acceptance",
    "Camera": "rig.camera",
    "ControlPoints": "features.control",
    "Frame": "images.frame",
    "ImagePoints": "features.image_points",
    "Positions": "position.positions",
    "Rig": "rig.rig",
    "Target": "features.target",
    "calibrate": "workflows.calibrate",
    "demo": "workflows.demo",
    "detect": "workflows.detect",
    "match": "workflows.match",
    "measure": "workflows.measure",
    "read_control": "features.control",
    "read_points": "features.points_table",
    "read_positions": "position.positions_table",
    "read_rig": "rig.rig_file",
    "report": "workflows.report",
    "run": "workflows.run",
    "verify": "workflows.verify",
    "volume": "workflows.volume",
}

__all__ = [
    "AcceptanceReport",
    "Camera",
    "CloseRangeError",
    "CloseRangeWarning",
    "ControlPoints",
    "Flag",
    "Frame",
    "ImagePoints",
    "Positions",
    "Rig",
    "Target",
    "__version__",
    "calibrate",
    "demo",
    "detect",
    "match",
    "measure",
    "read_control",
    "read_points",
    "read_positions",
    "read_rig",
    "report",
    "run",
    "verify",
    "volume",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
