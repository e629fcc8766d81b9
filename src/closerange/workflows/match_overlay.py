"""Pictures of a match as PNG files in a folder."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from closerange.delivery.canvas import Canvas, encode_png
from closerange.delivery.layout3d import paper_up
from closerange.delivery.match_drawings import (
    depth_limits,
    draw_depths,
    draw_element,
    draw_flags,
    draw_strengths,
)
from closerange.delivery.match_pictures import scene_pictures
from closerange.delivery.wire import draw_wire, neighbours
from closerange.errors import CloseRangeWarning, FileError
from closerange.files import write_bytes
from closerange.images import Frame
from closerange.matching.common_view import mean_direction
from closerange.rig.rig import Rig
from closerange.workflows.match import Matched
from closerange.workflows.match_inputs import Images, read_frames
from closerange.workflows.measure import measure

WIDE = 2.0
"""Pixels for each drawing unit: pictures are 1280 px wide."""


def check_folder(folder: Path | str) -> None:
    """Refuse a folder that pictures must not be put into, before any work is done.

    Parameters
    ----------
    folder : Path or str
        Where the pictures shall go.

    Raises
    ------
    FileError
        If it is a file, or holds anything already.
    """
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise FileError(f"{place}: is a file", remedy="name a folder")
    if place.is_dir() and any(place.iterdir()):
        raise FileError(
            f"{place}: the folder exists and is not empty",
            remedy="name another one, or empty it: pictures of another match are not mixed in",
        )


def write_match_pictures(
    rig: Rig, images: Images, matched: Matched, folder: Path | str
) -> tuple[Path, ...]:
    """Write the pictures of a match.

    Parameters
    ----------
    rig : Rig
        Calibrated cameras.
    images : mapping of str to path or Frame
        The images that were matched.
    matched : Matched
        What was found in them.
    folder : Path or str
        New or empty folder; made if it is missing.

    Returns
    -------
    tuple of Path
        ``edge-strength.png``, ``element.png`` (one point: its structuring element, the mapped
        form, the search), ``depth.png`` and ``flags.png`` (both images with all matches), and
        ``space.png``. Those that would show nothing are left out.

    Raises
    ------
    FileError
        If the folder is not empty or cannot be written.
    """
    check_folder(folder)
    frames = read_frames(rig, images)
    place = Path(folder)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(
            f"{place}: cannot be made ({error.strerror})", remedy="name another folder"
        ) from error
    written = []
    for name, drawing in _drawings(rig, frames, matched).items():
        path = place / f"{name}.png"
        write_bytes(path, encode_png(drawing.paint(WIDE)))
        written.append(path)
    return tuple(written)


def _drawings(rig: Rig, frames: Mapping[str, Frame], matched: Matched) -> dict[str, Canvas]:
    """Draw everything that there is to show."""
    matches = matched.matches
    scene = scene_pictures(rig, list(frames.values()), matches, matched.volume_mm)
    marks = [matches.xy_px[:, column] for column in range(len(matches.cameras))]
    drawings = {"edge-strength": draw_strengths(scene.views)}
    if scene.element is not None:
        drawings["element"] = draw_element(scene.element)
    drawings["flags"] = draw_flags(scene.views, marks, matches.point_flags)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)  # said when these are measured
        positions = measure(rig, matches)
    place = dict(zip(positions.keys(), positions.xyz_mm, strict=True))
    nowhere = np.full(3, np.nan)
    xyz = np.reshape([place.get(key, nowhere) for key in matches.keys()], (-1, 3))  # noqa: SIM118
    kept = matches.clean & np.isfinite(xyz).all(axis=1)
    if not kept.any():
        return drawings
    cameras = [rig.camera(name) for name in matches.cameras]
    axis = int(np.argmax(np.abs(mean_direction(cameras))))
    depth, name = xyz[kept, axis], "XYZ"[axis]
    drawings["depth"] = draw_depths(scene.views, [xy[kept] for xy in marks], depth, name)
    points = [point for point, use in zip(matches.point, kept, strict=True) if use]
    drawings["space"] = draw_wire(
        xyz[kept],
        neighbours(points, xyz[kept]),
        depth,
        volume_mm=rig.volume_mm,
        up=paper_up(rig.cameras, rig.volume_mm),
        limits=depth_limits(depth),
        label=f"{name} [mm]",
    )
    return drawings
