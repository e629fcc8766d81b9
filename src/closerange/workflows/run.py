"""The verb `run`: a whole project, from images to a report."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from closerange.delivery.overlays import Overlay
from closerange.errors import CloseRangeWarning, FileError
from closerange.features.image_points import ImagePoints
from closerange.files import dump_json, sha256, write_text
from closerange.flags import format_flags
from closerange.images import (
    check_duplicates,
    check_exposures,
    group_images,
    read_exposures,
    read_image,
)
from closerange.position.positions import Positions
from closerange.rig.rig import Rig
from closerange.rig.rig_file import rig_to_document, write_rig
from closerange.settings import Detection, Job, MatchJob, Settings, images_of, inside, read_settings
from closerange.verification.control_check import usable
from closerange.verification.judgement import Limits
from closerange.verification.result_file import write_result
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect
from closerange.workflows.inputs import copy_inputs, versions
from closerange.workflows.match_scene import MatchedScene, match_scene
from closerange.workflows.measure import measure
from closerange.workflows.report import RUN_SCHEMA, report
from closerange.workflows.result_folder import check_free, put
from closerange.workflows.run_overlays import JOB_OVERLAYS, MAX_OVERLAYS, overlays_of
from closerange.workflows.run_tables import CALIBRATION, write_tables
from closerange.workflows.verify import Result, verify

Announce = Callable[[str, int, int], None]
"""Called with (what is being done, done, total)."""

CYCLE_TIME_INCLUDES = (
    "the program's own time, mean of {} readings, from the images on disk to the position: reading "
    "and decoding the files, detection, position; without exposure, transfer and the command"
)


@dataclass(frozen=True, slots=True, eq=False)
class JobResult:
    """What one job of a project gave.

    Attributes
    ----------
    name : str
        As in the project file.
    points : ImagePoints
        Detected points.
    positions : Positions
        Measured positions.
    result : ControlCheck, AcceptanceReport, LengthCheck or None
        Comparison with the truth, if one was given and any position can be used.
    cycle_time_s : float
        The program's own time for one reading of all cameras, from the images on disk to the
        position. Written into the results only where the project limits it.
    scene : MatchedScene or None
        Matches and pictures of a job that matches; its `points` are those of the matches.
    """

    name: str
    points: ImagePoints
    positions: Positions
    result: Result | None
    cycle_time_s: float
    scene: MatchedScene | None = None

    @property
    def failure(self) -> str:
        """Why it cannot be relied upon, although its files are written; else empty."""
        if self.positions.doubt:
            return "its points contradict the rig, see the warning"
        if not usable(self.positions).any():
            return f"none of its {len(self.positions)} positions can be used"
        return self.result.hollow if self.result is not None else ""


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a project gave.

    Attributes
    ----------
    folder : Path
        Where the files are: rig.json, points and positions tables, results, report.html.
    rig : Rig
        The calibrated cameras.
    points : ImagePoints
        What they were calibrated from.
    jobs : tuple of JobResult
        In the order of the project file.
    warnings : tuple of str
        What the user should know.
    calibration_s : float
        Time that the calibration took, detection apart.
    """

    folder: Path
    rig: Rig
    points: ImagePoints
    jobs: tuple[JobResult, ...]
    warnings: tuple[str, ...]
    calibration_s: float

    @property
    def report(self) -> Path:
        """The report."""
        return self.folder / "report.html"


def run(
    project: Path | str,
    *,
    output: Path | str | None = None,
    overwrite: bool = False,
    keep_inputs: bool = False,
    announce: Announce | None = None,
) -> RunResult:
    """Run a project: detect, calibrate, measure, verify, report.

    Parameters
    ----------
    project : Path or str
        Project file; see `closerange.settings`.
    output : Path or str, optional
        Folder of the results instead of the one that the project names.
    overwrite : bool, optional
        Replace an existing folder of results.
    keep_inputs : bool, optional
        Copy all inputs into the folder ``inputs`` of the results.
    announce : callable, optional
        Called with (what is being done, done, total).

    Returns
    -------
    RunResult
        Results; the same are in the folder, which appears only when all is done.

    Raises
    ------
    CloseRangeError
        As the verbs; nothing is written then.
    """
    settings = read_settings(project)
    folder = Path(output) if output is not None else inside(settings, settings.outputs.folder)
    check_free(folder, Path(project), overwrite=overwrite)
    _check_named_files(settings)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CloseRangeWarning)
        result, overlays = _measure_all(settings, folder, announce)
    notes = tuple(dict.fromkeys(_relative(str(entry.message), settings) for entry in caught))
    result = replace(result, warnings=notes)
    hashes = _hashes(settings, Path(project))

    def fill(staged: Path) -> None:
        _write_all(staged, settings, result, overlays, hashes)
        if keep_inputs:
            copy_inputs(hashes, settings.folder, staged / "inputs")

    put(folder, fill)
    return result


def _measure_all(
    settings: Settings, folder: Path, announce: Announce | None
) -> tuple[RunResult, list[Overlay]]:
    said = announce or (lambda _what, _done, _total: None)
    points, _ = _detect_all(settings, settings.calibration, CALIBRATION, said)
    said("calibrating", 0, 1)
    start = time.perf_counter()
    calibration = settings.calibration
    rig = calibrate(
        points,
        control=inside(settings, calibration.control),
        model=calibration.model,
        volume_mm=calibration.volume_mm,
        accept_untrusted=calibration.accept_untrusted,
        progress=lambda done, total: said("calibrating", done, total),
    )
    elapsed = time.perf_counter() - start
    said("calibrating", 1, 1)
    jobs = tuple(
        _run_job(settings, job, rig, said)
        if isinstance(job, Job)
        else _run_match(settings, job, rig, said)
        for job in settings.job
    )
    overlays = overlays_of(settings, calibration, points, rig, most=MAX_OVERLAYS)
    for job, done in zip(settings.job, jobs, strict=True):
        if isinstance(job, Job):
            most = JOB_OVERLAYS * len(job.images)
            overlays += overlays_of(settings, job, done.points, None, most=most)
    return RunResult(folder, rig, points, jobs, (), elapsed), overlays


def _run_job(settings: Settings, job: Job, rig: Rig, said: Announce) -> JobResult:
    points, detection_s = _detect_all(settings, job, job.name, said)
    start = time.perf_counter()
    positions = measure(rig, points)
    readings = len(set(zip(points.placement, points.reading, strict=True)))
    cycle_s = (detection_s + time.perf_counter() - start) / readings
    result: Result | None = None
    if job.verify is not None and job.truth is not None and _any_usable(job, positions):
        timed = job.limits is not None and job.limits.cycle_time_s is not None
        result = verify(
            job.verify,
            positions,
            truth=inside(settings, job.truth),
            rig=rig,
            limits=_limits(job),
            cycle_time_s=cycle_s if timed else None,
            cycle_time_includes=CYCLE_TIME_INCLUDES.format(readings) if timed else "",
        )
    return JobResult(job.name, points, positions, result, cycle_s)


def _run_match(settings: Settings, job: MatchJob, rig: Rig, said: Announce) -> JobResult:
    what = f"matching: {job.name}"
    said(what, 0, 1)
    scene = match_scene(settings, job, rig, progress=lambda done, total: said(what, done, total))
    positions = scene.positions
    result: Result | None = None
    if job.verify is not None and job.truth is not None and _any_usable(job, positions):
        result = verify(job.verify, positions, truth=inside(settings, job.truth), rig=rig)
    points = scene.matches.to_image_points()
    return JobResult(job.name, points, positions, result, scene.elapsed_s, scene)


def _any_usable(job: Job | MatchJob, positions: Positions) -> bool:
    """Tell whether there is anything to compare; all the rest of a run is worth having without."""
    if usable(positions).any():
        return True
    flags = format_flags(int(np.bitwise_or.reduce(positions.flags)))
    warnings.warn(
        f"job {job.name!r} is not verified: none of its {len(positions)} positions can be used "
        f"({flags.replace('|', ', ')})",
        CloseRangeWarning,
        stacklevel=2,
    )
    return False


def _limits(job: Job) -> Limits | None:
    return None if job.limits is None else Limits.of(**job.limits.model_dump())


def _detect_all(
    settings: Settings, detection: Detection, what: str, said: Announce
) -> tuple[ImagePoints, float]:
    """Detect in the images of all cameras, after checking that they belong together.

    The time in s is that of reading the images and finding the target; not of the checks, which a
    whole folder needs and a single reading does not.
    """
    paths = {name: images_of(settings, listed) for name, listed in detection.images.items()}
    sets = group_images(paths, pattern=detection.placement_pattern)
    if detection.times is not None and detection.time_tolerance_s is not None:
        check_exposures(
            ((camera, one.placement, one.reading) for one in sets for camera in one.paths),
            read_exposures(inside(settings, detection.times)),
            tolerance_s=detection.time_tolerance_s,
        )
    check_duplicates(
        read_image(path, camera=camera) for one in sets for camera, path in one.paths.items()
    )
    total, before = sum(len(one.paths) for one in sets), 0
    found: ImagePoints | None = None
    start = time.perf_counter()
    for camera in detection.images:
        images = [one.paths[camera] for one in sets]
        points = detect(
            images,
            target=inside(settings, detection.target),
            camera=camera,
            placement_pattern=detection.placement_pattern,
            estimator=detection.estimator,
            crops=None if detection.crops is None else inside(settings, detection.crops),
            progress=_offset_progress(said, f"detecting: {what}", before, total),
        )
        before += len(images)
        found = points if found is None else found + points
    assert found is not None  # noqa: S101  # group_images refuses an empty job
    return found, time.perf_counter() - start


def _offset_progress(
    said: Announce, what: str, before: int, total: int
) -> Callable[[int, int], None]:
    return lambda done, _of: said(what, before + done, total)


def _relative(text: str, settings: Settings) -> str:
    """Leave the project's folder out of a message: it belongs to the machine."""
    return text.replace(f"{settings.folder}{os.sep}", "")


def _named_files(settings: Settings) -> list[str]:
    """List the tables and targets that the project names, as they are written there."""
    keys = ("target", "crops", "times", "control", "truth", "points")
    parts = (settings.calibration, *settings.job)
    return [name for part in parts for key in keys if (name := getattr(part, key, None))]


def _check_named_files(settings: Settings) -> None:
    """Refuse a file that is missing or outside before hours of detection, not after."""
    for name in _named_files(settings):
        if not inside(settings, name).exists():
            raise FileError(f"{name}: no such file in the project", remedy="correct the path")


def _hashes(settings: Settings, project: Path) -> dict[str, str]:
    """Return SHA-256 of every input, by its path in the project."""
    files = {project.name: project}
    files |= {name: inside(settings, name) for name in _named_files(settings)}
    for part in (settings.calibration, *settings.job):
        for patterns in part.images.values():
            for path in images_of(settings, patterns):
                files[path.relative_to(settings.folder).as_posix()] = path
    return {name: sha256(path) for name, path in sorted(files.items())}


def _write_all(
    folder: Path,
    settings: Settings,
    result: RunResult,
    overlays: list[Overlay],
    hashes: dict[str, str],
) -> None:
    """Write rig, tables, results, the record of the run and the report that is made from it."""
    write_rig(result.rig, folder / "rig.json")
    tables = write_tables(
        folder,
        {
            CALIBRATION: result.points,
            **{job.name: job.points for job in result.jobs if job.scene is None},
        },
        {job.name: job.positions for job in result.jobs},
        {job.name: job.scene.matches for job in result.jobs if job.scene is not None},
    )
    results: list[dict[str, Any]] = []
    for job in result.jobs:
        if job.result is not None:
            write_result(job.result, folder / f"{job.name.replace(' ', '-')}-result.json")
            results.append({"job": job.name, **job.result.to_document()})
    document = {
        "schema": RUN_SCHEMA,
        "title": settings.title,
        "rig": rig_to_document(result.rig),
        "tables": tables,
        "results": results,
        "overlays": [overlay.to_document() for overlay in overlays],
        "scenes": [
            {"job": job.name, **job.scene.pictures.to_document()}
            for job in result.jobs
            if job.scene is not None
        ],
        "warnings": list(result.warnings),
        "provenance": {**versions(), "inputs": hashes},
    }
    dump_json(document, folder / "run.json")
    # made from the files, not from memory: `closerange report` gives the same again
    write_text(folder / "report.html", report(folder / "run.json"))
