"""Real images: the three-camera step block and OpenCV's stereo chessboard.

    python benchmarks/bench_real.py [--shared ../shared]

The step block is calibrated from two thirds of its dots; the other third is measured and compared
with the dots' design positions. Our own detection of the dots is compared with the published one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from closerange.features.control import ControlPoints
from closerange.features.discs import find_discs
from closerange.features.image_points import ImagePoints
from closerange.features.pattern import Chessboard
from closerange.features.target import Target
from closerange.images import read_image
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect
from closerange.workflows.measure import measure

SIZE = (1280, 1024)
CAMERAS = ("cam1", "cam2", "cam3")


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


def own_detection(folder: Path) -> None:
    """Find the dots ourselves and compare with the published detections."""
    for camera in CAMERAS:
        frame = read_image(folder / f"cal_{camera}.png", camera=camera)
        discs = find_discs(frame, polarity="white-on-dark")
        published, _ = step_block_points(folder, camera)
        apart = np.linalg.norm(published.xy_px[:, None] - discs.xy_px[None], axis=2)
        nearest = apart.min(axis=1)
        near = nearest < 1.5
        print(
            f"own detection, {camera}: {int(near.sum())} of {len(published)} published dots within "
            f"1.5 px, median distance {np.median(nearest[near]):.3f} px, rms "
            f"{np.sqrt(np.mean(nearest[near] ** 2)):.3f} px; {len(discs.xy_px)} candidates"
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
    rms = np.sqrt(np.mean(np.sum(rig.residuals.residual_px**2, axis=1)))
    focal = ", ".join(f"{camera.matrix_px[0, 0]:.1f}" for camera in rig.cameras)
    print(
        f"chessboard: {int(points.found.sum())} of {len(points)} corners, rms {rms:.3f} px "
        f"(stereoCalibrate 0.217), baseline {baseline:.2f} mm (83.2), f {focal} px (532.8, 537.5)"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[1].parent / "shared")
    data = parser.parse_args().shared / "data"
    step_block(data / "myptv-step-block")
    own_detection(data / "myptv-step-block")
    chessboard(data / "opencv-stereo-chessboard")


if __name__ == "__main__":
    main()
