"""Sections on the tables of a measurement: image points and positions, job by job."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from closerange.delivery.excerpts import shown
from closerange.delivery.plots import axis_panels, panel_grid
from closerange.delivery.sheet import Block, Contents, Figure, Paragraph, Section, Table
from closerange.delivery.wording import (
    counted,
    fixed,
    flag_names,
    micrometres,
    mm,
    significant,
)
from closerange.features.image_points import ImagePoints
from closerange.geometry.arrays import FloatArray
from closerange.position.positions import Positions

MIN_READINGS = 20
"""Readings from which on their sequence is worth a figure."""


def points_section(contents: Contents) -> Section | None:
    """Count points, job by job and camera by camera.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    Section or None
        None without points.
    """
    rows, flagged = [], []
    for job, points in contents.points.items():
        rows += [(job, *_points_row(points.of_camera(name), name)) for name in points.cameras]
        flagged += [(job, *row) for row in _flagged_points(points)]
    if not rows:
        return None
    head = (
        *("job", "camera", "placements", "points", "found", "flagged"),
        *("median std x [px]", "median std y [px]"),
    )
    caption = "Image points of each camera, with the standard deviation that their fit states"
    blocks: list[Block] = [shown(rows, caption, head, texts=frozenset({0, 1}))]
    blocks += _thresholds(contents.points)
    if flagged:
        names = ("job", "camera", "placement", "point", "x [px]", "y [px]", "flags")
        texts = frozenset({0, 1, 2, 3, 6})
        blocks.append(shown(flagged, "Flagged points", names, texts=texts))
    return Section("points", "Image points", tuple(blocks))


def positions_section(contents: Contents) -> Section | None:
    """Show measured positions and, if there are enough, how their readings scatter.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    Section or None
        None without positions.
    """
    jobs = {name: positions for name, positions in contents.positions.items() if len(positions)}
    if not jobs:
        return None
    head = (
        *("job", "positions", "measured", "without a flag", "residual, rms [px]"),
        *(f"predicted std {axis}, median [µm]" for axis in "XYZ"),
    )
    rows = [(name, *_positions_row(positions)) for name, positions in jobs.items()]
    blocks: list[Block] = [shown(rows, "Measured positions in brief", head)]
    for name, positions in jobs.items():
        blocks += _readings(positions, name)
    compared = {check.get("job") for check in contents.checks}
    for name, positions in jobs.items():
        table = _positions_table(positions, name)
        # rows that were compared with a truth are printed there
        blocks.append(replace(table, folded=True, printed=False) if name in compared else table)
    return Section("positions", "Positions", tuple(blocks))


def _thresholds(points: Mapping[str, ImagePoints]) -> list[Block]:
    """Say which images Trussell's iteration could have split elsewhere."""
    reports = [(job, *item) for job, table in points.items() for item in table.thresholds.items()]
    if not reports:
        return []
    rows = [
        (
            *(job, camera, placement, reading, report.image),
            significant(report.threshold, 4),
            ", ".join(significant(point, 4) for point in report.fixed_points),
        )
        for job, (camera, placement, reading), report in reports
        if len(report.fixed_points) > 1
    ]
    several = f"{len(rows)} {'has' if len(rows) == 1 else 'have'}"
    text = (
        "Discs were separated from the background by Trussell's threshold, half-way between the "
        f"means of what it separates. Of {counted(len(reports), 'image')}, {several} more than one "
        "such value (fixed point), and that of the largest variance between the classes is taken, "
        "whatever the start."
    )
    if not rows:
        return [Paragraph(text)]
    head = (
        *("job", "camera", "placement", "reading", "values"),
        *("threshold taken", "all fixed points"),
    )
    caption = "Thresholds of images with more than one fixed point, in grey values"
    return [Paragraph(text), shown(rows, caption, head, texts=frozenset({0, 1, 2, 3, 4, 6}))]


def _points_row(points: ImagePoints, camera: str) -> tuple[str, ...]:
    std = np.sqrt(np.einsum("nii->ni", points.cov_px2))
    return (
        camera,
        str(len(set(points.placement))),
        str(len(points)),
        str(int(points.found.sum())),
        str(int((points.flags != 0).sum())),
        *(fixed(_median(std[:, axis]), 4) for axis in (0, 1)),
    )


def _flagged_points(points: ImagePoints) -> list[tuple[str, ...]]:
    bad = points.select(points.flags != 0)
    return [
        (
            *(bad.camera[i], bad.placement[i], bad.point[i]),
            *(fixed(float(value), 2) for value in bad.xy_px[i]),
            ", ".join(flag_names(int(bad.flags[i]))),
        )
        for i in range(len(bad))
    ]


def _positions_row(positions: Positions) -> tuple[str, ...]:
    std = np.sqrt(np.einsum("mii->mi", positions.cov_mm2))
    good = positions.measured & (positions.flags == 0)
    residual = positions.residual_px[np.isfinite(positions.residual_px)]
    rms = float(np.sqrt(np.mean(residual**2))) if residual.size else float("nan")
    return (
        str(len(positions)),
        str(int(positions.measured.sum())),
        str(int(good.sum())),
        significant(rms, 2),
        *(micrometres(_median(std[:, axis])) for axis in range(3)),
    )


def _readings(positions: Positions, job: str) -> list[Block]:
    """Draw readings in their order, about their mean: scatter, drift and blunders show there.

    Of many readings at one position these (figure 3.2 of the thesis: 100 readings); otherwise
    those of all positions together.
    """
    keys = list(zip(positions.placement, positions.point, strict=True))
    counts = Counter(key for key, known in zip(keys, positions.measured, strict=True) if known)
    most = max(counts, key=lambda key: counts[key], default=None)
    if most is None or counts[most] < 2:
        return []
    if counts[most] >= MIN_READINGS:
        return _readings_at_one(positions, [key == most for key in keys], job)
    repeated = {key for key, count in counts.items() if count > 1}
    chosen = np.array([key in repeated for key in keys]) & positions.measured
    if chosen.sum() < MIN_READINGS:
        return []
    return _readings_of_all(positions.xyz_mm[chosen], keys, chosen, job)


def _readings_at_one(positions: Positions, is_there: list[bool], job: str) -> list[Block]:
    rows = np.flatnonzero(np.array(is_there) & positions.measured)
    xyz, first = positions.xyz_mm[rows], int(rows[0])
    mean, std = xyz.mean(axis=0), xyz.std(axis=0, ddof=1)
    placement, point = positions.placement[first], positions.point[first]
    names = (job and f"job {job}", placement and f"placement {placement}", f"point {point}")
    caption = (
        f"{len(rows)} readings at one position ({', '.join(filter(None, names))}), each minus "
        f"their mean X {mm(mean[0])} Y {mm(mean[1])} Z {mm(mean[2])} mm; standard deviation "
        f"X {micrometres(std[0])} Y {micrometres(std[1])} Z {micrometres(std[2])} µm."
    )
    return [_sequence(1000 * (xyz - mean), "Readings at one position", caption)]


def _readings_of_all(
    xyz_mm: FloatArray,
    keys: list[tuple[str, str]],
    chosen: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    job: str,
) -> list[Block]:
    own = [key for key, is_chosen in zip(keys, chosen, strict=True) if is_chosen]
    number = {key: i for i, key in enumerate(dict.fromkeys(own))}
    group = np.array([number[key] for key in own])
    count = np.bincount(group)
    mean = np.stack([np.bincount(group, xyz_mm[:, axis]) for axis in range(3)], axis=1)
    deviation = xyz_mm - (mean / count[:, None])[group]
    std = np.sqrt((deviation**2).sum(axis=0) / (len(own) - len(count)))
    of_job = f" of job {job}" if job else ""
    caption = (
        f"All {len(own)} readings{of_job} in the order of the table, each minus the mean of its "
        f"position ({counted(len(count), 'position')}); pooled standard deviation "
        f"X {micrometres(std[0])} Y {micrometres(std[1])} Z {micrometres(std[2])} µm."
    )
    return [_sequence(1000 * deviation, "Readings about the mean of their position", caption)]


def _sequence(deviation_um: FloatArray, title: str, caption: str) -> Figure:
    panels = axis_panels(
        deviation_um,
        unit="µm",
        quantity="reading minus mean",
        x_label="number of the reading",
        mark="chain",
    )
    picture = panel_grid(panels, columns=1, height=108, title=title, description=caption)
    return Figure(picture, caption)


def _positions_table(positions: Positions, job: str) -> Table:
    std = np.sqrt(np.einsum("mii->mi", positions.cov_mm2))
    cells = [
        (
            positions.placement[i],
            positions.reading[i],
            positions.point[i],
            *map(mm, positions.xyz_mm[i]),
            *(micrometres(float(value)) for value in std[i]),
            fixed(float(positions.residual_px[i]), 4),
            str(int(positions.cameras[i])),
            ", ".join(flag_names(int(positions.flags[i]))),
        )
        for i in range(len(positions))
    ]
    head = (
        *("placement", "reading", "point"),
        *(f"{axis} [mm]" for axis in "XYZ"),
        *(f"std {axis} [µm]" for axis in "XYZ"),
        *("residual [px]", "cameras", "flags"),
    )
    marked = frozenset(i for i, flag in enumerate(positions.flags) if flag)
    caption = "Measured positions with their predicted standard deviation"
    caption = f"{caption}: {job}" if job else caption
    return shown(cells, caption, head, texts=frozenset({0, 1, 2, 11}), marked=marked, wide=True)


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")
