"""Calibration and measurement against the Cramer-Rao bound.

Rigs A and B of `closerange.verification.scenes` (1.5 m, f = 4800 px; 0.35 m, f = 1300 px), 27 and
63 exact control points, model ``brown``. 400 held-out positions are measured after each of many
independent calibrations:

- total: 3-D RMS error of noisy held-out pixels, over the bound;
- calibration: the same for noise-free pixels, the part that averaging cannot remove;
- coverage: share of held-out positions inside their own 95 % region.

Each figure has its standard error over the calibrations.

The time is that of the calibration of 54 points and two cameras, with a model that is given and
with the one that is chosen: of simulated points, which come without covariances, and of the discs
of the demonstration's images, which have ellipses and covariances, so that weights, perspective
and blunders have to be dealt with. Finding the discs in the images is not in it. Run ``python
benchmarks/bench_calibration.py``; ``--quick`` takes a few seconds.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np

from closerange.errors import CloseRangeWarning
from closerange.features.control import ControlPoints, read_control
from closerange.features.image_points import ImagePoints
from closerange.position.measure import measure_points
from closerange.rig.calibrate import calibrate_rig
from closerange.rig.rig import Rig
from closerange.verification.bound import BROWN, position_bound, rms_3d_mm
from closerange.verification.scenes import (
    SyntheticRig,
    control_grid,
    observe,
    random_positions,
    rig_a,
    rig_b,
)
from closerange.verification.statistics import region_coverage
from closerange.workflows.detect import detect

HELD_OUT = 400
MODEL = "brown"
TIMED_POINTS, REPEATS = 54, 25


@dataclass(frozen=True)
class Figures:
    """One line of the table; `se_` are standard errors over the calibrations."""

    rig: str
    points: int
    runs: int
    bound_total_um: float
    bound_calibration_um: float
    total: float
    se_total: float
    calibration: float
    se_calibration: float
    coverage: float
    se_coverage: float
    mean_ratio: float


def main() -> None:
    options = _options()
    rng = np.random.default_rng(options.seed)
    runs = 20 if options.quick else options.runs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        lines = [
            _figures(scene, points, runs, rng)
            for scene in (rig_a(), rig_b())
            for points in (27, 63)
        ]
        seconds = _times(rng)
    if options.json:
        document = {
            "model": MODEL,
            "seed": options.seed,
            "held_out": HELD_OUT,
            "figures": [asdict(line) for line in lines],
            "calibration_54_points_s": seconds,
        }
        print(json.dumps(document, indent=1, allow_nan=False))
    else:
        _print(lines, seconds)


def _figures(scene: SyntheticRig, points: int, runs: int, rng: np.random.Generator) -> Figures:
    control = control_grid(points)
    held_out = random_positions(HELD_OUT, scene.volume_mm, rng, prefix="h")
    bound = position_bound(scene.cameras, BROWN, control.xyz_mm, held_out.xyz_mm, scene.noise_px)
    total_mm, calibration_mm = (rms_3d_mm(cov) for cov in bound)
    total, calibration, inside, ratio = np.array(
        [_one_run(scene, control, held_out, rng) for _ in range(runs)]
    ).T
    return Figures(
        scene.name,
        points,
        runs,
        1000 * total_mm,
        1000 * calibration_mm,
        *_rms_ratio(total, total_mm),
        *_rms_ratio(calibration, calibration_mm),
        float(inside.mean()),
        float(inside.std(ddof=1) / np.sqrt(runs)),
        float(ratio.mean()),
    )


def _one_run(
    scene: SyntheticRig, control: ControlPoints, held_out: ControlPoints, rng: np.random.Generator
) -> tuple[float, float, float, float]:
    """Calibrate once; return both mean squared 3-D errors, coverage and mean e'V^-1e / 3."""
    rig = _calibrate(scene, control, rng)
    squares = []
    for noise_px in (0.0, scene.noise_px):
        seen = observe(scene.cameras, held_out, noise_px=noise_px, rng=rng)
        positions = measure_points(rig, seen)
        error = positions.xyz_mm - held_out.xyz_mm
        squares.append(float((error**2).sum(axis=1).mean()))
    coverage = region_coverage(error, positions.cov_mm2, dof=positions.dof)
    return squares[1], squares[0], coverage.share, coverage.mean_ratio


def _calibrate(scene: SyntheticRig, control: ControlPoints, rng: np.random.Generator) -> Rig:
    seen = observe(scene.cameras, control, noise_px=scene.noise_px, rng=rng)
    sizes = {camera.name: camera.size_px for camera in scene.cameras}
    return calibrate_rig(seen, control, sizes, model=MODEL)


def _rms_ratio(squares_mm2: Any, bound_mm: float) -> tuple[float, float]:
    """Return RMS over the bound and its standard error (half of the mean square's)."""
    mean = squares_mm2.mean()
    relative = squares_mm2.std(ddof=1) / np.sqrt(len(squares_mm2)) / mean
    ratio = float(np.sqrt(mean) / bound_mm)
    return ratio, float(ratio * relative / 2)


def _times(rng: np.random.Generator) -> dict[str, dict[str, float]]:
    """Time calibrations of 54 points and two cameras, by what they are and the model."""
    control = control_grid(TIMED_POINTS)
    cases = {
        f"rig {scene.name}": (
            observe(scene.cameras, control, noise_px=scene.noise_px, rng=rng),
            control,
            {camera.name: camera.size_px for camera in scene.cameras},
        )
        for scene in (rig_a(), rig_b())
    }
    with as_file(files("closerange.workflows") / "demo_data") as folder:
        cases["discs in images"] = _demonstration(folder)
    return {
        f"{name}, model {model}": _time(*case, model=model)
        for name, case in cases.items()
        for model in ("brown", "auto")
    }


def _demonstration(
    folder: Path,
) -> tuple[ImagePoints, ControlPoints, Mapping[str, tuple[int, int]]]:
    """Detect the discs of the demonstration's plate at six heights: 54 points."""
    found: ImagePoints | None = None
    for camera in ("left", "right"):
        images = sorted((folder / "calibration").glob(f"{camera}_*.png"))[: TIMED_POINTS // 9]
        points = detect(
            images, target=folder / "plate.toml", camera=camera, placement_pattern="_(z.*)$"
        )
        found = points if found is None else found + points
    assert found is not None
    return found, read_control(folder / "control.csv"), found.size_px


def _time(
    points: ImagePoints,
    control: ControlPoints,
    sizes: Mapping[str, tuple[int, int]],
    *,
    model: str,
) -> dict[str, float]:
    """Time the calibration of both cameras, in seconds, after one run to warm up."""
    seconds = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter(), time.process_time()
        calibrate_rig(points, control, sizes, model=model)
        seconds.append((time.perf_counter() - start[0], time.process_time() - start[1]))
    wall, cpu = np.array(seconds[1:]).T
    return {
        "cpu_median": float(np.median(cpu)),
        "cpu_min": float(cpu.min()),
        "cpu_max": float(cpu.max()),
        "wall_median": float(np.median(wall)),
    }


def _print(lines: list[Figures], seconds: dict[str, dict[str, float]]) -> None:
    print(f"model {MODEL}, {HELD_OUT} held-out positions, error / Cramer-Rao bound (+- 1 s.e.)")
    print("rig points runs   bound um       total            calibration      coverage 95 %")
    for line in lines:
        print(
            f"{line.rig:3s} {line.points:6d} {line.runs:4d}   "
            f"{line.bound_total_um:4.1f} / {line.bound_calibration_um:4.1f}   "
            f"{line.total:.3f} +- {line.se_total:.3f}   "
            f"{line.calibration:.3f} +- {line.se_calibration:.3f}   "
            f"{line.coverage:.3f} +- {line.se_coverage:.3f}"
        )
    for name, spent in seconds.items():
        cpu, least, most, wall = (1000 * spent[key] for key in spent)
        print(
            f"{TIMED_POINTS} points, two cameras, {name}: {cpu:.1f} ms of computation (CPU time, "
            f"median of {REPEATS}; {least:.1f} to {most:.1f} ms), {wall:.1f} ms by the clock"
        )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=300, help="calibrations of each scene (300)")
    parser.add_argument("--quick", action="store_true", help="20 calibrations of each scene")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="JSON on stdout instead of a table")
    options = parser.parse_args()
    if options.runs < 2:
        parser.error(f"--runs is {options.runs}; standard errors need at least 2")
    return options


if __name__ == "__main__":
    main()
