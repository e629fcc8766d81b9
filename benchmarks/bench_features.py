"""Disc centres against the truth of rendered images, for both estimators.

    python benchmarks/bench_features.py [--shared ../shared]

Centres are compared with the projection of the discs' centres after the perspective and lens bias
was taken off by the rig that was calibrated from the same images.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.features.pattern import DiscGrid
from closerange.features.target import Target
from closerange.rig.rig import Residuals
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect

SETS = {
    "A_calib_discs": DiscGrid(3, 3, (45.0, 45.0), 16.0, "white-on-dark", "upright"),
    "B_calib_discs_black": DiscGrid(3, 3, (45.0, 45.0), 14.0, "dark-on-white", "upright"),
}


def truth_rows(folder: Path) -> dict[tuple[str, str, str], dict[str, str]]:
    """Return the truth by (camera, placement, point)."""
    with (folder / "targets.csv").open() as stream:
        return {
            (row["camera"], row["pose"], name(int(row["target"]))): row
            for row in csv.DictReader(stream)
        }


def name(target: int) -> str:
    """Return the point's name for a target's number in the truth."""
    return f"r{target // 3}c{target % 3}"


def control_of(truth: dict[tuple[str, str, str], dict[str, str]]) -> ControlPoints:
    """Return the known world positions."""
    rows = {key[1:]: row for key, row in truth.items()}
    xyz = [[float(row[axis]) for axis in ("X_mm", "Y_mm", "Z_mm")] for row in rows.values()]
    return ControlPoints.of([k[1] for k in rows], xyz, placement=[k[0] for k in rows])


def centres(points: Residuals, truth: dict[tuple[str, str, str], dict[str, str]]) -> np.ndarray:
    """Return errors of corrected centres against the true projection, (N, 2) px."""
    keys = zip(points.camera, points.placement, points.point, strict=True)
    true = [[float(truth[key]["u_centre"]), float(truth[key]["v_centre"])] for key in keys]
    return points.xy_px - np.array(true)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[1].parent / "shared")
    folder = parser.parse_args().shared / "data" / "rendered"
    if not folder.is_dir():
        parser.error(f"no folder {folder}; name the one that holds data/ with --shared")
    print("rms error of disc centres per image, px: worst image (all images), u / v")
    for set_name, pattern in SETS.items():
        truth = truth_rows(folder / set_name)
        control = control_of(truth)
        cameras = sorted({key[0] for key in truth})
        for estimator in ("least-squares", "border-centroid"):
            points: ImagePoints | None = None
            for camera in cameras:
                images = sorted((folder / set_name).glob(f"{camera}_*.png"))
                found = detect(
                    images,
                    target=Target.of(pattern),
                    camera=camera,
                    placement_pattern="_(z.*)$",
                    estimator=estimator,
                )
                points = found if points is None else points + found
            assert points is not None
            missed = int((~points.found).sum())
            rig = calibrate(points, control=control, model="brown")
            error = centres(rig.residuals, truth)
            images_of = np.array(
                [
                    f"{c}/{p}"
                    for c, p in zip(rig.residuals.camera, rig.residuals.placement, strict=True)
                ]
            )
            per_image = np.array(
                [
                    np.sqrt(np.mean(error[images_of == one] ** 2, axis=0))
                    for one in np.unique(images_of)
                ]
            )
            whole = np.sqrt(np.mean(error**2, axis=0))
            wrong = int((np.abs(error) > 1).any(axis=1).sum())
            print(
                f"{set_name:20} {estimator:16} worst {per_image[:, 0].max():.4f} / "
                f"{per_image[:, 1].max():.4f}  all {whole[0]:.4f} / {whole[1]:.4f}  "
                f"{len(points)} discs, {missed} missed, {wrong} wrong labels"
            )


if __name__ == "__main__":
    main()
