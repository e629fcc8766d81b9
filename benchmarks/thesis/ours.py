"""The thesis' experiments repeated with this program, on rendered and synthetic data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.position import measure_points
from closerange.rig.rig import Rig
from closerange.verification.acceptance import AcceptanceReport
from closerange.verification.control_check import compare_with_control
from closerange.verification.scenes import control_grid, observe, random_positions, rig_a
from closerange.verification.single_point import single_point_test
from closerange.verification.statistics import Coverage, region_coverage
from closerange.workflows.calibrate import calibrate
from thesis.images import (
    as_bare_points,
    diagonal_mm,
    plate_control,
    plate_points,
    single_control,
    single_points,
    with_check,
)
from thesis.lens_terms import distortion_tables
from thesis.positions import BLUNDER_MM, averages, read_run
from thesis.tables import AXES, FloatArray, Lines, fixed, markdown, read_json

SEED = 1989
SINGLE_CUBE_MM = 100.0  # side of the cube in which the rendered single disc stands
ESTIMATORS = {"border-centroid": "thesis' method", "least-squares": "this program"}


@dataclass(frozen=True, slots=True, eq=False)
class Tested:
    """A single-point test and how many single readings lie in their predicted regions."""

    report: AcceptanceReport
    readings: Coverage


def experiments_section(data: Path) -> Lines:
    """Return everything that this program measures itself."""
    control = plate_control(data)
    plates = {name: plate_points(data, name) for name in ESTIMATORS}
    plates["border-centroid"] = as_bare_points(plates["border-centroid"])
    singles = {name: single_points(data, name) for name in ESTIMATORS}
    singles["border-centroid"] = as_bare_points(singles["border-centroid"])
    truth = single_control(data)
    rig = calibrate(plates["least-squares"], control=control, model="brown")
    return [
        *_what_is_compared(control),
        *calibration_section(control, plates),
        *distortion_tables(plates, control, singles, truth),
        *single_point_section(rig, singles["least-squares"], truth),
    ]


def _what_is_compared(control: ControlPoints) -> Lines:
    size = np.ptp(control.xyz_mm, axis=0)
    return [
        (
            "**Read this first.** The thesis measured with two cameras of 1989, a plotted target "
            "and dial gauges of 0.0127 mm. The figures below come from *rendered images* of a "
            "plate whose positions are exact: there is lens distortion, blur, noise and 8-bit "
            "rounding, and no mechanics. They show what calibration and evaluation do with good "
            "data. They do not show that real hardware reaches the same."
        ),
        "",
        (
            f"The rendered volume is {size[0]:g} x {size[1]:g} x {size[2]:g} mm (diagonal "
            f"{fixed(diagonal_mm(control.xyz_mm), 1)} mm), seen by two cameras of 640 x 512 px "
            "from 1.5 m under 25 degrees; the thesis' is 12.7 x 12.7 x 15.24 mm (diagonal "
            f"{fixed(_thesis_diagonal(), 1)} mm), seen from 0.6 m under 45 degrees. Hence each "
            'error is also given in parts per million of the diagonal. "Thesis\' method" is the '
            "border centroid (2.7) and the direct linear transformation with a12 = 1, both as "
            'printed, on the same images; "this program" is the fit of the discs, the Brown model '
            "and the correction of disc centres."
        ),
        "",
    ]


def _thesis_diagonal() -> float:
    return float(np.linalg.norm([12.7, 12.7, 15.24]))


def calibration_section(control: ControlPoints, plates: dict[str, ImagePoints]) -> Lines:
    """Chapter 2 again: 18, 27 and 54 points with check points apart."""
    models = {"border-centroid": "thesis-dlt", "least-squares": "brown"}
    rows = []
    for count in (18, 27, 54):
        rows += _printed_rows(count)
        for estimator, name in ESTIMATORS.items():
            marked = with_check(control, count)
            rig = calibrate(
                plates[estimator], control=marked, model=models[estimator], accept_untrusted=True
            )
            check = compare_with_control(measure_points(rig, plates[estimator]), marked)
            for role in ("fitted", "check"):
                group = check.groups[role]
                label = f"{count} points, {name}, rendered: {role} ({group.count})"
                rows.append(_error_row(label, group.mean_abs_mm, diagonal_mm(control.xyz_mm)))
    header = ["experiment (rows)", *(f"{a}, mm" for a in (*AXES, "space")), "space, ppm"]
    return [
        "### Calibration with 18, 27 and 54 points",
        "",
        (
            "Average magnitude of calculated minus original position. Check points are the plate's "
            "other heights, inside of the fitted block; the thesis' check rows lie partly outside."
        ),
        *markdown(header, rows),
    ]


def _printed_rows(count: int) -> list[list[str]]:
    run = read_run(count)
    sound = ~(run.error_mm[:, 3] > BLUNDER_MM)
    rows = []
    for role, mask in (("fitted", ~run.check), ("check", run.check & sound)):
        label = f"{count} points, printed 1989: {role} ({mask.sum()})"
        rows.append(_error_row(label, averages(run, mask), _thesis_diagonal()))
    return rows


def _error_row(label: str, mean_abs_mm: FloatArray, diagonal: float) -> list[str]:
    ppm = 1e6 * mean_abs_mm[3] / diagonal
    return [label, *(fixed(value, 4) for value in mean_abs_mm), fixed(ppm, 0)]


TEST_HEADER = (
    "test",
    *(f"error {a}, mm" for a in AXES),
    *(f"half range {a}, mm" for a in AXES),
    *(f"repeatability {a}, mm" for a in AXES),
    "readings inside their 95 % region, %",
)


def single_point_section(rig: Rig, points: ImagePoints, truth: ControlPoints) -> Lines:
    """Chapter 3 again: 90 positions, rendered with 3 readings and synthetic with 10."""
    rendered = _test(rig, points, truth)
    synthetic = _synthetic_test()
    printed = read_json("fig_3_5_3_8_3_11_envelopes.json")["axes"]
    rows = [
        [
            "printed 1989, 90 x 10",
            *(f"{printed[a]['emin_mm']:g} to {printed[a]['emax_mm']:g}" for a in AXES),
            *(fixed(printed[a]["half_range_recomputed_mm"], 3) for a in AXES),
            *("n/a",) * 4,
        ],
        _report_row("rendered, 90 x 3", rendered),
        _report_row("synthetic rig A, 90 x 10", synthetic),
    ]
    share = 1e6 * rendered.report.accuracy.rms_mm[3] / (SINGLE_CUBE_MM * np.sqrt(3))
    return [
        "### The single-point test",
        "",
        (
            "Calibrated with all 63 discs of the plate; then a single disc at 90 random positions "
            f"in a cube of {SINGLE_CUBE_MM:g} mm, none of which took part in the calibration. The "
            "synthetic test has no images: rig A of `verification.scenes`, 63 points in a cube of "
            f"150 mm, noise of 0.05 px on each coordinate, seed {SEED}. Errors are actual minus "
            "mean; repeatability is the pooled standard deviation of the readings."
        ),
        *markdown(TEST_HEADER, rows),
        (
            f"RMS error in space: rendered {_in_space(rendered)} mm ({fixed(share, 0)} ppm of the "
            f"cube's diagonal), synthetic {_in_space(synthetic)} mm. The thesis gives no "
            "repeatability that could be recomputed."
        ),
        "",
        (
            "The last column counts single readings. All of them share one calibration, so a "
            "single test is no more than an indication; the tests of this program count over many "
            "calibrations. In the rendered images the three readings of a position differ in "
            "sensor noise only and share the edge noise of the path tracing, 0.003 to 0.006 px at "
            "a disc's centre: their spread is smaller than their errors, and averaging them gains "
            "little."
        ),
        "",
    ]


def _in_space(tested: Tested) -> str:
    errors = tested.report.accuracy
    return f"{fixed(errors.rms_mm[3], 4)} (largest {fixed(errors.max_mm[3], 4)})"


def _report_row(label: str, tested: Tested) -> list[str]:
    report, errors = tested.report, tested.report.accuracy
    ranges = [
        f"{fixed(low, 4)} to {fixed(high, 4)}"
        for low, high in zip(errors.lowest_mm, errors.highest_mm, strict=True)
    ]
    return [
        label,
        *ranges,
        *(fixed(value, 4) for value in errors.half_range_mm),
        *(fixed(value, 4) for value in report.repeatability.pooled.std_mm),
        fixed(100 * tested.readings.share, 1),
    ]


def _synthetic_test() -> Tested:
    """Calibrate rig A from noisy observations and measure 90 positions ten times."""
    rng = np.random.default_rng(SEED)
    scene = rig_a()
    grid = control_grid(63)
    seen = observe(scene.cameras, grid, noise_px=scene.noise_px, rng=rng)
    rig = calibrate(seen, control=grid, model="brown")
    truth = random_positions(90, scene.volume_mm, rng)
    readings = observe(scene.cameras, truth, noise_px=scene.noise_px, rng=rng, readings=10)
    return _test(rig, readings, truth)


def _test(rig: Rig, points: ImagePoints, truth: ControlPoints) -> Tested:
    """Measure and evaluate."""
    positions = measure_points(rig, points)
    errors = positions.xyz_mm - truth.xyz_mm[truth.rows_for(positions.placement, positions.point)]
    return Tested(
        single_point_test(positions, truth),
        region_coverage(errors, positions.cov_mm2, dof=positions.dof),
    )
