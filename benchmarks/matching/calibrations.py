"""Rigs calibrated from the rendered images of disc plates, through the program's own verbs."""

from __future__ import annotations

import csv
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from closerange.errors import CloseRangeWarning, DetectionError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.features.pattern import DiscGrid
from closerange.features.target import Target
from closerange.rig.rig import Rig
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect
from matching.scene_truth import read_cameras


def calibration_folder(scene: Path) -> Path | None:
    """Return the folder of disc plates beside a scene that was taken with the same cameras."""
    wanted = read_cameras(scene)
    for folder in sorted(scene.resolve().parent.iterdir()):
        if not ((folder / "targets.csv").is_file() and (folder / "cameras.json").is_file()):
            continue
        if not any(folder.glob("left_z*.png")):
            continue
        have = read_cameras(folder)
        if all(
            name in have and np.allclose(have[name].projection_matrix, camera.projection_matrix)
            for name, camera in wanted.items()
        ):
            return folder
    return None


def calibrated_rig(folder: Path, cameras: tuple[str, ...]) -> Rig:
    """Detect the discs in all images of the cameras and calibrate from their known places."""
    with (folder / "targets.csv").open(encoding="utf-8") as stream:
        rows = [row for row in csv.DictReader(stream) if row["camera"] in cameras]
    grid, name = _grid(rows)
    images = sorted({(row["camera"], row["pose"], row["image"]) for row in rows})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        points = _detected(folder, images, grid)
        known = {
            (row["pose"], name[int(row["target"])]): [float(row[f"{a}_mm"]) for a in "XYZ"]
            for row in rows
        }
        control = ControlPoints.of(
            [point for _, point in known],
            list(known.values()),
            placement=[pose for pose, _ in known],
        )
        return calibrate(points, control=control)


def _detected(folder: Path, images: list[tuple[str, str, str]], grid: DiscGrid) -> ImagePoints:
    tables = []
    for camera, pose, image in images:
        for polarity in ("white-on-dark", "dark-on-white"):
            try:
                target = Target.of(replace(grid, polarity=polarity))
                tables.append(detect(folder / image, target=target, camera=camera, placement=pose))
                break
            except DetectionError:
                if polarity == "dark-on-white":
                    raise
    points = tables[0]
    for table in tables[1:]:
        points += table
    return points


def _grid(rows: list[dict[str, str]]) -> tuple[DiscGrid, dict[int, str]]:
    """Return the pattern of a plate parallel to XY and the name of each target's number."""
    pose = rows[0]["pose"]
    own = {
        int(r["target"]): (float(r["X_mm"]), float(r["Y_mm"])) for r in rows if r["pose"] == pose
    }
    across = sorted({round(x, 3) for x, _ in own.values()})
    down = sorted({round(y, 3) for _, y in own.values()}, reverse=True)
    pitch = (across[1] - across[0], down[0] - down[1])
    grid = DiscGrid(
        len(down), len(across), pitch, 2 * float(rows[0]["radius_mm"]), "white-on-dark", "upright"
    )
    name = {
        number: f"r{down.index(round(y, 3))}c{across.index(round(x, 3))}"
        for number, (x, y) in own.items()
    }
    return grid, name
