"""The single-point test and the length bars, on shipped images with exact truth.

    python benchmarks/bench_verification.py

Calibrates from the plate at seven heights, measures 90 positions x 3 readings and seven bars, and
compares errors with what the stated covariances predict. Then counts how often the 95 % region of a
mean of ten readings holds, over many calibrations of a synthetic rig.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from closerange.features.discs import find_discs
from closerange.features.image_points import ImagePoints
from closerange.images import read_image
from closerange.position.measure import measure_points
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.rig import Rig
from closerange.verification.acceptance import AcceptanceReport
from closerange.verification.scenes import control_grid, observe, random_positions, rig_a
from closerange.verification.single_point import single_point_test
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect, read_crops
from closerange.workflows.measure import measure
from closerange.workflows.verify import verify

LENGTHS_MM = (80.0, 80.0, 80.0, 80.0, 80.0, 80.0, 90.0)
BAR_DISC_MM = 10.0

LOWEST_RATIO, HIGHEST_RATIO = 0.8, 1.25
"""Bar for what is observed over what is predicted, on each axis and in space."""

CALIBRATIONS, READINGS = 40, 10

COMMON_PX = (0.0, 0.1)
"""Error of a synthetic image point that all readings share (print, light), beside the noise of
0.05 px that differs in each."""


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
    print_ratios("accuracy observed / predicted", result.prediction.accuracy_ratio)
    what = "image noise" if result.prediction.noise_stated else "a whole reading's covariance"
    ratio = result.prediction.repeatability_ratio
    print_ratios(f"repeatability observed / predicted from {what}", ratio)
    share = result.prediction.noise_share
    print(f"share of the stated variance that differs between readings: {share:.2f}")
    share = 100 * result.coverage.share
    print(f"95 % region holds {share:.1f} % of the means")


def print_ratios(name: str, ratio: np.ndarray) -> None:
    """Print a ratio of X, Y, Z and in space beside its bar."""
    passed = bool(((ratio >= LOWEST_RATIO) & (ratio <= HIGHEST_RATIO)).all())
    values = " / ".join(f"{value:.2f}" for value in ratio)
    bar = f"{LOWEST_RATIO}-{HIGHEST_RATIO}"
    print(f"{name}, X / Y / Z / 3-D: {values} (bar {bar}: {'passed' if passed else 'missed'})")


def means_of_readings(common_px: float, stated: str) -> None:
    """Print how often the 95 % region of a mean holds its true position."""
    rng = np.random.default_rng(1)
    tests = [synthetic_test(rng, common_px, stated) for _ in range(CALIBRATIONS)]
    shares = np.array([test.coverage.share for test in tests])
    print(
        f"== means of {READINGS} readings, synthetic, {CALIBRATIONS} calibrations, "
        f"common error {common_px} px, stated: {stated}: 95 % region holds "
        f"{100 * shares.mean():.1f} % +- {100 * shares.std(ddof=1) / np.sqrt(CALIBRATIONS):.1f}"
    )
    for name in ("accuracy", "repeatability")[: 2 if "noise" in stated else 1]:
        squares = [getattr(test.prediction, f"{name}_ratio") ** 2 for test in tests]
        print_ratios(f"{name} observed / predicted", np.sqrt(np.mean(squares, axis=0)))


def synthetic_test(rng: np.random.Generator, common_px: float, stated: str) -> AcceptanceReport:
    """Calibrate rig A from 63 points and test it at 90 random positions."""
    scene = rig_a()
    total_px = float(np.hypot(common_px, scene.noise_px))
    total = (total_px if "covariance" in stated else np.nan) ** 2 * np.eye(2)
    noise = (scene.noise_px if "noise" in stated else np.nan) ** 2 * np.eye(2)
    grid, truth = control_grid(63), random_positions(90, scene.volume_mm, rng)
    seen = observe(scene.cameras, grid, noise_px=total_px, rng=rng)
    seen = replace(seen, cov_px2=np.broadcast_to(total, (len(seen), 2, 2)))
    sizes = {camera.name: camera.size_px for camera in scene.cameras}
    rig = calibrate_rig(seen, grid, sizes, model="brown")
    readings = observe(scene.cameras, truth, noise_px=scene.noise_px, rng=rng, readings=READINGS)
    common = common_px * rng.standard_normal((len(scene.cameras), 1, len(truth), 2))
    common = np.broadcast_to(common, (len(scene.cameras), READINGS, len(truth), 2))
    readings = replace(
        readings,
        xy_px=readings.xy_px + common.reshape(-1, 2),
        cov_px2=np.broadcast_to(total, (len(readings), 2, 2)),
        noise_cov_px2=np.broadcast_to(noise, (len(readings), 2, 2)),
    )
    return single_point_test(measure_points(rig, readings), truth)


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
    for common_px in COMMON_PX:
        for stated in ("covariance and noise", "covariance", "nothing"):
            means_of_readings(common_px, stated)


if __name__ == "__main__":
    main()
