"""Table 3: centres of discs in rendered images with exact truth."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from closerange.features.discs import find_discs
from closerange.geometry.transform import RigidTransform
from closerange.images import Frame, read_image
from closerange.rig.camera import Camera
from closerange.rig.disc_bias import outline_centre
from closerange.rig.distortion import BrownIdeal
from peer_tables.table import (
    OURS,
    PEER,
    VARIANT,
    Bar,
    FloatArray,
    Measured,
    Quantity,
    bars,
    lines,
    rotated,
    run,
    timed,
)
from peers import circles_grid, contour_ellipse, contour_moments, grey_centroid
from thesis.tables import Lines

SETS = {"A_calib_discs": True, "B_calib_discs_black": False}  # bright discs?
GRID = (3, 3)
SAME_PX = 5.0  # discs are 140 px apart: the nearest centre is that disc's or was not found

QUANTITIES = (Quantity("centre", "px", 1, 4),)


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """One image and where perfect detectors would find its discs."""

    frame: Frame
    bright: bool
    outline_px: FloatArray
    area_px: FloatArray


def compare(data: Path, images: int | None, timings: int) -> tuple[Lines, list[Bar]]:
    """Find the discs of both sets; `images` limits their number."""
    text: Lines = []
    held: list[Bar] = []
    apart = 0.0
    for name, bright in SETS.items():
        folder = data / "rendered" / name
        if not folder.is_dir():
            text += [f"## Discs, {name}: not run: no such folder in the data", ""]
            continue
        views = _views(folder, bright)
        views = views[:: max(1, len(views) // images)] if images else views
        apart = max(apart, *(_apart(view) for view in views))
        methods = _measure(views, timings)
        title = f"Disc centres, {name}, {len(views)} images of {GRID[0] * GRID[1]} discs"
        text += lines(title, methods, QUANTITIES, "time")
        held += bars(name, methods, QUANTITIES)
    text += [
        (
            "RMS over an image's discs of the distance from the truth, medians over images. The "
            "truth is the centre of the ellipse fitted to the disc's exact outline in the image: "
            "one and the same perspective and lens bias is taken off for every method. The "
            "centroid of the exact image area, the ideal of moments, differs from it by "
            f"{apart:.0e} px at most."
        ),
        "",
    ]
    return text, held


def _apart(view: _View) -> float:
    return float(np.linalg.norm(view.outline_px - view.area_px, axis=1).max())


def _measure(views: list[_View], timings: int) -> list[Measured]:
    work: dict[str, Callable[[_View], FloatArray]] = {
        "closerange": partial(_ours, estimator="least-squares"),
        "closerange border-centroid (thesis)": partial(_ours, estimator="border-centroid"),
        "cv2 findCirclesGrid (SimpleBlobDetector)": partial(_peer, method=circles_grid.centres),
        "cv2 contour moments": partial(_peer, method=contour_moments.centres),
        "cv2 contour fitEllipse": partial(_peer, method=contour_ellipse.centres),
        "grey-value centroid": partial(_peer, method=grey_centroid.centres),
    }
    kinds = [OURS, VARIANT, PEER, PEER, PEER, PEER]
    methods = [Measured(name, kind) for name, kind in zip(work, kinds, strict=True)]
    for find in work.values():
        find(views[0])  # warm up
    for number, view in enumerate(views):
        for method in rotated(methods, number):
            run(method, partial(_one, work[method.method], view, timings), len(QUANTITIES))
    return methods


def _one(find: Callable[[_View], FloatArray], view: _View, timings: int) -> tuple[float, ...]:
    """Time one image several times; return the median and the RMS error."""
    tried = [timed(lambda: find(view)) for _ in range(timings)]
    found = tried[0][1]
    apart = np.linalg.norm(found[None] - view.outline_px[:, None], axis=2).min(axis=1)
    if not (apart < SAME_PX).all():
        raise LookupError(f"{np.count_nonzero(apart >= SAME_PX)} discs were not found")
    error = float(np.sqrt(np.mean(apart**2)))
    return float(np.median([seconds for seconds, _ in tried])), error


def _ours(view: _View, estimator: str) -> FloatArray:
    polarity = "white-on-dark" if view.bright else "dark-on-white"
    return find_discs(view.frame, polarity=polarity, estimator=estimator).xy_px


def _peer(view: _View, method: Callable[..., FloatArray]) -> FloatArray:
    return method(view.frame.pixels, bright=view.bright, grid=GRID)


def _views(folder: Path, bright: bool) -> list[_View]:
    cameras = _cameras(folder)
    with (folder / "targets.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    views = []
    for image in sorted({row["image"] for row in rows}):
        own = [row for row in rows if row["image"] == image]
        camera = cameras[own[0]["camera"]]
        xyz, normal = _columns(own, "X_mm", "Y_mm", "Z_mm"), _columns(own, "nx", "ny", "nz")
        views.append(
            _View(
                read_image(folder / image, camera=camera.name),
                bright,
                outline_centre(camera, xyz, normal, _columns(own, "radius_mm")[:, 0]),
                _columns(own, "u_area", "v_area"),
            )
        )
    return views


def _columns(rows: list[dict[str, str]], *names: str) -> FloatArray:
    return np.array([[float(row[name]) for name in names] for row in rows])


def _cameras(folder: Path) -> dict[str, Camera]:
    """Read the true cameras."""
    document: dict[str, Any] = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))
    return {
        name: Camera(
            name,
            (true["width"], true["height"]),
            np.array(true["K"], np.float64),
            RigidTransform(np.array(true["R"]), np.array(true["t_mm"])),
            BrownIdeal(*true["dist_k1_k2_p1_p2_k3"]),
        )
        for name, true in document["cameras"].items()
    }
