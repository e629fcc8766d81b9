"""The single-point test and the length bars, on shipped images with exact truth.

    python benchmarks/bench_verification.py

Calibrates from the plate at seven heights, measures 90 positions x 3 readings and seven bars, and
compares errors with what the stated covariances predict.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from closerange.features.discs import find_discs
from closerange.features.image_points import ImagePoints
from closerange.images import read_image
from closerange.rig.rig import Rig
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect, read_crops
from closerange.workflows.measure import measure
from closerange.workflows.verify import verify

LENGTHS_MM = (80.0, 80.0, 80.0, 80.0, 80.0, 80.0, 90.0)
BAR_DISC_MM = 10.0


def calibrated(folder: Path, model: str) -> Rig:
    """Calibrate from the plate."""
    points: ImagePoints | None = None
    for camera in ("left", "right"):
        found = detect(
            sorted((folder / "calibration").glob(f"{camera}_*.png")),
            target=folder / "plate.toml",
            camera=camera,
            placement_pattern="_(z.*)$",
        )
        points = found if points is None else points + found
    assert points is not None
    return calibrate(points, control=folder / "control.csv", model=model)


def single_point(folder: Path, rig: Rig) -> None:
    """Measure the 90 positions."""
    points: ImagePoints | None = None
    for camera in ("left", "right"):
        found = detect(
            sorted((folder / "verify").glob(f"*_{camera}_*.png")),
            target=folder / "disc.toml",
            camera=camera,
            placement_pattern=r"^(p\d+)_\w+_r(?P<reading>\d+)$",
            crops=folder / "verify" / "crops.csv",
        )
        points = found if points is None else points + found
    assert points is not None
    positions = measure(rig, points)
    result = verify("single-point", positions, truth=folder / "verify" / "truth.csv")
    truth = dict(zip(result.placement, result.truth_mm, strict=True))
    error = positions.xyz_mm - np.array([truth[p] for p in positions.placement])
    um = 1000 * np.sqrt(np.mean(error**2, axis=0))
    print(f"positions: 3-D rms {np.linalg.norm(um):.2f} um (limit 12), X/Y/Z {_three(um)}")
    stated = np.sqrt(np.mean(np.einsum("mii->mi", positions.cov_mm2), axis=0))
    total = np.linalg.norm(um) / np.linalg.norm(1000 * stated)
    print(f"one reading, observed / stated: X/Y/Z {_three(um / 1000 / stated)}, 3-D {total:.2f}")
    worst = 1000 * result.accuracy.max_mm
    print(f"accuracy (worst mean of 3): {_three(worst)} um, 3-D {worst[3]:.1f}")
    print(f"repeatability (pooled s): {_three(1000 * result.repeatability.pooled.std_mm)} um")
    ratios = " / ".join(f"{value:.2f}" for value in result.prediction.accuracy_ratio)
    print(f"accuracy observed / predicted, X / Y / Z / 3-D: {ratios} (0.8-1.25)")
    share = result.prediction.noise_share
    print(f"share of the stated variance that differs between readings: {share:.2f}")
    share = 100 * result.coverage.share
    print(f"95 % region holds {share:.1f} % of the means")


def _three(values: np.ndarray) -> str:
    """Write the values of the three axes."""
    return " / ".join(f"{value:.2f}" for value in values[:3])


def bars(folder: Path, rig: Rig) -> None:
    """Measure the bars; their two discs are told apart by which pairing lets the rays meet."""
    crops = read_crops(folder / "bars" / "crops.csv")
    errors = []
    for bar, length in enumerate(LENGTHS_MM):
        found = {}
        for camera in ("left", "right"):
            name = f"bar{bar}_{camera}.png"
            discs = find_discs(
                read_image(folder / "bars" / name, camera=camera), polarity="white-on-dark"
            )
            clean = discs.flags == 0
            found[camera] = (
                discs.xy_px[clean] + crops[name],
                discs.cov_px2[clean],
                discs.ellipse[clean],
            )
        pairings = [measured_pair(rig, found, order) for order in ([0, 1], [1, 0])]
        best = min(pairings, key=lambda positions: float(np.nansum(positions.residual_px)))
        errors.append(float(np.linalg.norm(best.xyz_mm[0] - best.xyz_mm[1])) - length)
    um = 1000 * np.array(errors)
    print("lengths, error in um:", " ".join(f"{value:+.1f}" for value in um))
    print(f"worst length {np.abs(um).max():.1f} um (limit 15)")


def measured_pair(rig: Rig, found: dict, order: list[int]) -> object:
    """Measure both discs, the right image's taken in a given order."""
    tables = []
    for camera, rows in (("left", [0, 1]), ("right", order)):
        xy, cov, ellipse = found[camera]
        tables.append(
            ImagePoints.of(
                camera=camera,
                point=["a", "b"],
                xy_px=xy[rows],
                cov_px2=cov[rows],
                ellipse=ellipse[rows],
                disc_diameter_mm=BAR_DISC_MM,
            )
        )
    return measure(rig, tables[0] + tables[1])


def main() -> None:
    with as_file(files("closerange.workflows") / "demo_data") as folder:
        for model in ("auto", "brown"):
            rig = calibrated(folder, model)
            print(f"== model {model} ({rig.model}), {rig.trust}, noise {rig.noise_px:.4f} px")
            single_point(folder, rig)
            bars(folder, rig)


if __name__ == "__main__":
    main()
