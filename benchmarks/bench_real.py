"""Real images: the three-camera step block and OpenCV's stereo chessboard.

    python benchmarks/bench_real.py [--shared ../shared]

The step block is calibrated from two thirds of its dots; the other third is measured and compared
with the dots' design positions. Our own detection of the dots is compared with the published one,
and its stated covariances with the errors of the dots that were held out.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from closerange.features.control import ControlPoints
from closerange.features.discs import find_discs
from closerange.features.image_points import ImagePoints
from closerange.features.pattern import Chessboard
from closerange.features.target import Target
from closerange.geometry.covariance import mahalanobis_squared, region_limit
from closerange.images import read_image
from closerange.rig.observations import EXCLUDING
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect
from closerange.workflows.measure import measure

SIZE = (1280, 1024)
CAMERAS = ("cam1", "cam2", "cam3")

MEDIAN_RATIO = 2.366 / 3
"""Median of e'V^-1e / 3 where covariances hold: that of chi-square, 3 degrees of freedom."""


def step_block_points(folder: Path, camera: str) -> tuple[ImagePoints, dict[str, list[float]]]:
    """Read the published detections of a camera and the dots' design positions."""
    table = np.genfromtxt(folder / f"points_{camera}.csv", delimiter=",", names=True)
    names = [
        f"{x:g},{y:g},{z:g}" for x, y, z in zip(table["X"], table["Y"], table["Z"], strict=True)
    ]
    xy = np.stack([table["x"], table["y"]], axis=1)
    points = ImagePoints.of(camera=camera, point=names, xy_px=xy, size_px={camera: SIZE})
    return points, dict(
        zip(names, np.stack([table["X"], table["Y"], table["Z"]], 1).tolist(), strict=True)
    )


def step_block(folder: Path) -> None:
    """Calibrate from two thirds of the dots and measure the rest."""
    tables = [step_block_points(folder, camera) for camera in CAMERAS]
    points = tables[0][0] + tables[1][0] + tables[2][0]
    known = {name: xyz for _, table in tables for name, xyz in table.items()}
    ordered = sorted(known, key=lambda name: known[name])
    for model in ("auto", "brown", "dlt"):
        squares, count = np.zeros(3), 0
        worst = np.zeros(3)
        for third in range(3):
            check = np.arange(len(ordered)) % 3 == third
            control = ControlPoints.of(ordered, [known[n] for n in ordered], check=check)
            rig = calibrate(points, control=control, model=model, accept_untrusted=True)
            held_out = {n for n, c in zip(ordered, check, strict=True) if c}
            chosen = points.select([name in held_out for name in points.point])
            positions = measure(rig, chosen)
            use = positions.measured
            error = positions.xyz_mm[use] - [
                known[n] for n, u in zip(positions.point, use, strict=True) if u
            ]
            squares += np.sum(error**2, axis=0)
            count += len(error)
            worst = np.maximum(worst, np.sqrt(np.mean(error**2, axis=0)))
        rms = np.sqrt(squares / count)
        print(
            f"step block, model {model:6} ({rig.model}): held-out rms X/Y/Z "
            f"{rms[0]:.4f} / {rms[1]:.4f} / {rms[2]:.4f} mm over {count} dots in three turns; "
            f"worst turn {worst[0]:.4f} / {worst[1]:.4f} / {worst[2]:.4f}  (limits .025 .035 .09)"
        )


def own_detection(folder: Path) -> tuple[ImagePoints, dict[str, list[float]]]:
    """Find the dots ourselves, compare with the published detections; return what was found."""
    points: ImagePoints | None = None
    known: dict[str, list[float]] = {}
    for camera in CAMERAS:
        frame = read_image(folder / f"cal_{camera}.png", camera=camera)
        discs = find_discs(frame, polarity="white-on-dark")
        published, design = step_block_points(folder, camera)
        known.update(design)
        apart = np.linalg.norm(published.xy_px[:, None] - discs.xy_px[None], axis=2)
        row, nearest = apart.argmin(axis=1), apart.min(axis=1)
        near = nearest < 1.5
        flags = discs.flags[row[near]]
        kept_out = int(((flags & int(EXCLUDING)) != 0).sum())
        print(
            f"own detection, {camera}: {int(near.sum())} of {len(published)} published dots within "
            f"1.5 px, of these {int((flags == 0).sum())} without a flag and {kept_out} kept out of "
            f"fits; median distance {np.median(nearest[near]):.3f} px, rms "
            f"{np.sqrt(np.mean(nearest[near] ** 2)):.3f} px; {len(discs.xy_px)} candidates"
        )
        found = ImagePoints.of(
            camera=camera,
            point=[name for name, yes in zip(published.point, near, strict=True) if yes],
            xy_px=discs.xy_px[row[near]],
            cov_px2=discs.cov_px2[row[near]],
            flags=flags,
            size_px={camera: SIZE},
        )
        points = found if points is None else points + found
    assert points is not None
    return points, known


def coverage(points: ImagePoints, known: dict[str, list[float]]) -> None:
    """Measure every third dot with a calibration from the rest; compare errors with covariances."""
    ordered = sorted(known, key=lambda name: known[name])
    check = np.arange(len(ordered)) % 3 == 0
    control = ControlPoints.of(ordered, [known[n] for n in ordered], check=check)
    held_out = {n for n, c in zip(ordered, check, strict=True) if c}
    unknown = replace(points, cov_px2=np.full_like(points.cov_px2, np.nan))
    for label, dots in (("stated covariances", points), ("without covariances", unknown)):
        rig = calibrate(dots, control=control, accept_untrusted=True)
        positions = measure(rig, dots.select([name in held_out for name in dots.point]))
        error = positions.xyz_mm - [known[n] for n in positions.point]
        good = positions.measured & (positions.flags == 0)
        rms, everything = (
            " / ".join(f"{value:.4f}" for value in np.sqrt(np.mean(error[rows] ** 2, axis=0)))
            for rows in (good, positions.measured)
        )
        square = mahalanobis_squared(error, positions.cov_mm2)[good]
        inside = np.mean(square <= region_limit(3, positions.dof))
        print(
            f"own detection, {label}: {len(positions)} held-out dots, {positions.measured.sum()} "
            f"measured (rms {everything} mm), {good.sum()} without a flag: rms {rms} mm, "
            f"e'V^-1e / 3 mean {square.mean() / 3:.2f}, median "
            f"{np.median(square) / 3 / MEDIAN_RATIO:.2f} of chi-square's, inside the 95 % region "
            f"{inside:.1%}"
        )


def chessboard(folder: Path) -> None:
    """Calibrate the stereo chessboard from unknown poses."""
    target = Target.of(Chessboard(rows=6, columns=9, square_mm=25.0))
    points: ImagePoints | None = None
    for camera in ("left", "right"):
        images = sorted(folder.glob(f"{camera}[0-9][0-9].jpg"))
        found = detect(images, target=target, camera=camera, placement_pattern=r"(\d+)$")
        points = found if points is None else points + found
    assert points is not None
    control = ControlPoints.of(target.point, target.xyz_mm)
    rig = calibrate(points, control=control, model="brown", free_poses=True)
    baseline = np.linalg.norm(rig.cameras[0].centre_mm - rig.cameras[1].centre_mm)
    square = np.sum(rig.residuals.residual_px**2, axis=1)
    fitted = rig.residuals.fitted
    rms, all_rms = np.sqrt(np.mean(square[fitted])), np.sqrt(np.mean(square))
    focal = ", ".join(f"{camera.matrix_px[0, 0]:.1f}" for camera in rig.cameras)
    print(
        f"chessboard: {int(points.found.sum())} of {len(points)} corners, rms {rms:.3f} px of "
        f"the {fitted.sum()} fitted, {all_rms:.3f} px with the {(~fitted).sum()} kept out "
        f"(stereoCalibrate, of all: 0.217), baseline {baseline:.2f} mm (83.2), f {focal} px "
        "(532.8, 537.5)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[1].parent / "shared")
    data = parser.parse_args().shared / "data"
    if not data.is_dir():
        parser.error(f"no folder {data}; name the one that holds data/ with --shared")
    step_block(data / "myptv-step-block")
    coverage(*own_detection(data / "myptv-step-block"))
    chessboard(data / "opencv-stereo-chessboard")


if __name__ == "__main__":
    main()
