"""Why a calibration is bad: usual mistakes are tried, and one that explains it is named."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from closerange.errors import GeometryError, InputError
from closerange.features.control import ControlPoints
from closerange.geometry.arrays import FloatArray, IntArray
from closerange.rig.camera import Camera
from closerange.rig.camera_fit import CameraFit, fit_camera
from closerange.rig.dlt import MIN_POINTS
from closerange.rig.models import model_named
from closerange.rig.observations import Observations
from closerange.rig.outliers import CleanFit
from closerange.rig.view import View

BAD_PX = 1.0
"""Noise above which mistakes are looked for: detectors, and fingers on an enlarged image, point
to better than a pixel."""

BAD_SHARE = 0.2
"""Share of outliers above which mistakes are looked for: blunders are rarer."""

EXPLAINS = 5.0
"""A mistake is named only if undoing it lowers the residual at least by this factor. Mistakes
of labels lower it by tens to thousands; chance, and one lens term too few, by less than two."""

TIED = 2.0
"""Explanations whose residuals differ by less than this factor cannot be told apart."""

NAMED = 4
"""Explanations named at most, the most frequent mistakes first; on flat parallel targets all
mirrorings look alike."""

ENOUGH = 0.8
"""Share of the points that must keep a known position under other labels."""

MAX_PLACEMENTS = 60
"""Placements tried for exchanged cameras: bounds the time to some seconds."""

UNITS = {25.4: "inches against mm", 10.0: "cm against mm", 1000.0: "m against mm"}
SCALE_TOLERANCE = 0.1
"""Blooming and thresholds change the apparent size of discs by some percent."""

_GRID = re.compile(r"r(\d+)c(\d+)")


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A mistake undone in one camera."""

    words: str
    view: View


def explain_camera(
    observations: Observations, control: ControlPoints, camera: int, found_px: float
) -> None:
    """Look for a mistake in the naming or axes of one camera's points.

    Parameters
    ----------
    observations : Observations
        All points.
    control : ControlPoints
        Known positions.
    camera : int
        Index of the camera.
    found_px : float
        Its noise as things stand; infinite if it cannot be fitted at all.

    Raises
    ------
    GeometryError
        If undoing a mistake lowers the noise by the factor `EXPLAINS`: the message says which
        and by how much.
    """
    found: list[tuple[float, str]] = []
    for trial in _trials(observations, control, camera):
        noise = _noise(trial.view)
        if noise * EXPLAINS < found_px:
            found.append((noise, trial.words))
    if not found:
        return
    best = min(noise for noise, _ in found)
    words = [words for noise, words in found if noise <= TIED * best][:NAMED]
    before = f"falls from {found_px:.3g} px to" if np.isfinite(found_px) else "becomes"
    raise GeometryError(
        f"camera {observations.cameras[camera]!r}: the points do not belong to one view as they "
        f"are named; with {' or with '.join(words)} the residual {before} {best:.2g} px",
        remedy="correct the labels or axes in the tables; where several causes fit alike, look "
        "which one applies",
    )


def explain_placement(
    observations: Observations, control: ControlPoints, camera: int, clean: CleanFit
) -> None:
    """Look for one placement whose points were named wrongly or went to another camera.

    Parameters
    ----------
    observations : Observations
        All points.
    control : ControlPoints
        Known positions.
    camera : int
        Index of the camera.
    clean : CleanFit
        As things stand.

    Raises
    ------
    GeometryError
        If the camera fits without the placement, and a mistake explains the placement's points.
    """
    placements = list(dict.fromkeys(observations.points.placement))
    if not 1 < len(placements) <= MAX_PLACEMENTS:
        return
    everything = observations.view(camera, observations.points.xy_px)
    names = [observations.points.placement[i] for i in observations.rows(camera)]
    for placement in placements:
        here = np.array([name == placement for name in names])
        if here.all() or not here.any():
            continue
        if 2 * np.count_nonzero(~clean.kept[here]) > np.count_nonzero(here):
            rest: CameraFit | None = clean.fit  # has done without the placement already
        else:
            rest = _quick_fit(everything.select(~here))
        if rest is None or np.sqrt(rest.rss_px2 / rest.dof) * EXPLAINS > clean.plain_px:
            continue
        rows = observations.rows(camera)[here]
        before = _median_miss(rest.camera, observations.xyz_mm[rows], observations, rows)
        words, after = _best_words(observations, control, rest.camera, rows)
        if after * EXPLAINS < before:
            raise GeometryError(
                f"camera {everything.name!r}, placement {placement!r}: with {words} in this "
                f"placement the residual falls from {before:.3g} px to {after:.2g} px",
                remedy="correct the names there, and look whether all placements and cameras are "
                "named rightly",
            )


def _best_words(
    observations: Observations, control: ControlPoints, camera: Camera, rows: IntArray
) -> tuple[str, float]:
    """Return the mistake that explains the points of one image best, and the residual left."""
    points = observations.points
    found = [("nothing changed", float("inf"))]
    for words, rename in relabellings(control):
        known = control.rows_for(
            [points.placement[i] for i in rows], [rename(points.point[i]) for i in rows]
        )
        if (known >= 0).all():
            found.append((words, _median_miss(camera, control.xyz_mm[known], observations, rows)))
    here = points.placement[rows[0]]
    for index, name in enumerate(observations.cameras):
        theirs = np.array([i for i in observations.rows(index) if points.placement[i] == here])
        if name != camera.name and len(theirs):
            miss = _median_miss(camera, observations.xyz_mm[theirs], observations, theirs)
            found.append((f"the points of camera {name!r} (cameras exchanged)", miss))
    return min(found, key=lambda pair: pair[1])


def _median_miss(
    camera: Camera, xyz_mm: FloatArray, observations: Observations, rows: IntArray
) -> float:
    miss = np.linalg.norm(observations.points.xy_px[rows] - camera.project(xyz_mm), axis=1)
    return float(np.median(np.where(np.isfinite(miss), miss, np.inf)))


def check_scale(observations: Observations, cameras: tuple[Camera, ...]) -> None:
    """Compare the size of discs with that of their images.

    Parameters
    ----------
    observations : Observations
        Points; those that are no discs say nothing.
    cameras : tuple of Camera
        Calibrated cameras.

    Raises
    ------
    InputError
        If control positions and disc diameters are in different units. Without discs the
        images fit a world of any scale.
    """
    ratios = []
    for index, camera in enumerate(cameras):
        rows = observations.rows(index)
        depth = camera.depth_mm(observations.xyz_mm[rows])
        focal = np.sqrt(camera.matrix_px[0, 0] * camera.matrix_px[1, 1])
        expected = observations.points.disc_diameter_mm[rows] / 2 * focal / depth
        ratios.append(observations.points.ellipse[rows, 0] / expected)
    ratio = np.concatenate(ratios)
    ratio = ratio[np.isfinite(ratio)]
    if not len(ratio):
        return
    middle = float(np.median(ratio))
    for factor, words in UNITS.items():
        for scale, which in ((factor, "larger"), (1 / factor, "smaller")):
            if abs(middle / scale - 1) < SCALE_TOLERANCE:
                raise InputError(
                    f"the discs' images are {max(middle, 1 / middle):.3g} times {which} than their "
                    f"diameters and the control positions say: {words}?",
                    remedy="give control positions and disc_diameter_mm both in mm",
                )


def _trials(observations: Observations, control: ControlPoints, camera: int) -> Iterator[_Trial]:
    rows = observations.rows(camera)
    as_is = observations.view(camera, observations.points.xy_px)
    width, height = as_is.size_px
    relabelled = []
    for words, relabel in relabellings(control):
        names = [relabel(observations.points.point[i]) for i in rows]
        placements = [observations.points.placement[i] for i in rows]
        known = control.rows_for(placements, names)
        if np.count_nonzero(known >= 0) >= max(ENOUGH * len(rows), MIN_POINTS):
            kept = as_is.select(known >= 0)
            xyz = control.xyz_mm[known[known >= 0]]
            relabelled.append(_Trial(words, View(kept.name, kept.size_px, xyz, kept.xy_px)))
    yield from relabelled[:2]
    yield _Trial(
        "the control axes mirrored (they are left-handed)",
        View(as_is.name, as_is.size_px, as_is.xyz_mm * [1, 1, -1], as_is.xy_px),
    )
    yield _Trial(
        "x_px and y_px exchanged",
        View(as_is.name, (height, width), as_is.xyz_mm, as_is.xy_px[:, ::-1]),
    )
    yield from relabelled[2:]
    flipped = np.column_stack([as_is.xy_px[:, 0], height - 1 - as_is.xy_px[:, 1]])
    yield _Trial(
        "y_px counted from the other edge", View(as_is.name, as_is.size_px, as_is.xyz_mm, flipped)
    )


def relabellings(control: ControlPoints) -> Iterator[tuple[str, Callable[[str], str]]]:
    """List the mistakes that are made with a grid's labels ``r{r}c{c}``.

    Parameters
    ----------
    control : ControlPoints
        Whose names tell the size of the grid.

    Yields
    ------
    words, rename : str, callable
        What was mistaken, and the right name of a wrong one; nothing for names of another kind.
    """
    cells = [match for name in control.point if (match := _GRID.fullmatch(name))]
    if not cells or 2 * len(cells) < len(control.point):
        return
    last_row = max(int(cell[1]) for cell in cells)
    last_column = max(int(cell[2]) for cell in cells)

    def renamed(new: Callable[[int, int], tuple[int, int]]) -> Callable[[str], str]:
        def rename(name: str) -> str:
            cell = _GRID.fullmatch(name)
            if cell is None:
                return name
            row, column = new(int(cell[1]), int(cell[2]))
            return f"r{row}c{column}"

        return rename

    yield "rows and columns exchanged", renamed(lambda r, c: (c, r))
    yield (
        "the order of the points reversed (the target turned by half a turn)",
        renamed(lambda r, c: (last_row - r, last_column - c)),
    )
    yield "the columns counted from the other side", renamed(lambda r, c: (r, last_column - c))
    yield "the rows counted from the other side", renamed(lambda r, c: (last_row - r, c))
    yield (
        "the target turned by a quarter turn",
        renamed(lambda r, c: (c, last_row - r)),
    )
    yield (
        "the target turned back by a quarter turn",
        renamed(lambda r, c: (last_column - c, r)),
    )


def _quick_fit(view: View) -> CameraFit | None:
    model = model_named("brown")
    if not model.affordable(len(view)):
        model = model_named("pinhole")
    try:
        return fit_camera(view, model.free)
    except GeometryError:
        return None


def _noise(view: View) -> float:
    """Noise of a quick fit, infinite where there is none."""
    fit = _quick_fit(view)
    return float("inf") if fit is None else float(np.sqrt(fit.rss_px2 / fit.dof))
