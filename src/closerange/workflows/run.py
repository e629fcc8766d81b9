"""The verb `run`: a whole project, from images to a report."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from closerange.delivery.overlays import Overlay, make_overlay
from closerange.errors import CloseRangeWarning, FileError
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import write_points
from closerange.files import dump_json, sha256, write_text
from closerange.images import (
    check_duplicates,
    group_images,
    natural_key,
    placement_and_reading,
    read_image,
)
from closerange.position.positions import Positions
from closerange.position.positions_table import write_positions
from closerange.rig.rig import Rig
from closerange.rig.rig_file import rig_to_document, write_rig
from closerange.settings import Detection, Job, Settings, images_of, inside, read_settings
from closerange.verification.result_file import write_result
from closerange.version import __version__
from closerange.workflows.calibrate import calibrate
from closerange.workflows.detect import detect
from closerange.workflows.measure import measure
from closerange.workflows.report import RUN_SCHEMA, report_of_run
from closerange.workflows.verify import Result, verify

Announce = Callable[[str, int, int], None]
"""Called with (what is being done, done, total)."""

MAX_OVERLAYS = 20
"""Pictures in a report: of more images the first ones are shown."""


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
        Comparison with the truth, if one was given.
    """

    name: str
    points: ImagePoints
    positions: Positions
    result: Result | None


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """What a project gave.

    Attributes
    ----------
    folder : Path
        Where the files are: rig.json, points and positions tables, results, report.html.
    rig : Rig
        The calibrated cameras.
    jobs : tuple of JobResult
        In the order of the project file.
    warnings : tuple of str
        What the user should know.
    calibration_s : float
        Time that the calibration took, detection apart.
    """

    folder: Path
    rig: Rig
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
    _check_free(folder, Path(project), overwrite=overwrite)
    _check_named_files(settings)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CloseRangeWarning)
        result, overlays = _measure_all(settings, folder, announce)
    notes = tuple(dict.fromkeys(str(entry.message) for entry in caught))
    result = RunResult(folder, result.rig, result.jobs, notes, result.calibration_s)
    hashes = _hashes(settings, Path(project))
    _put(folder, lambda staged: _write_all(staged, settings, result, overlays, hashes))
    return result


def _put(folder: Path, write: Callable[[Path], None]) -> None:
    """Fill a folder aside and rename it: an interruption leaves the old one, or none."""
    target = folder.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as aside:
            staged, old = Path(aside) / "new", Path(aside) / "old"
            staged.mkdir()
            write(staged)
            if target.exists():
                target.replace(old)
            try:
                staged.replace(target)
            except BaseException:
                if old.exists():
                    old.replace(target)
                raise
    except OSError as error:
        raise FileError(
            f"{folder}: cannot be written ({error.strerror or error})",
            remedy="check that the place is writable and has room",
        ) from error


def _check_free(folder: Path, project: Path, *, overwrite: bool) -> None:
    place = folder.resolve()
    nearest = next(part for part in (place, *place.parents) if part.exists())
    if not nearest.is_dir():
        raise FileError(f"{nearest}: is a file", remedy="name a folder")
    if project.resolve().is_relative_to(place):
        raise FileError(
            f"{folder}: the project lies in it, results replace their whole folder",
            remedy="name a folder of their own",
        )
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise FileError(
            f"{folder}: the folder exists and is not empty",
            remedy="name another one, or allow to replace it with --overwrite",
        )
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "run.json").is_file():
        raise FileError(
            f"{folder}: not a folder of results (no run.json in it); it is left alone",
            remedy="name another folder",
        )


def _measure_all(
    settings: Settings, folder: Path, announce: Announce | None
) -> tuple[RunResult, list[Overlay]]:
    said = announce or (lambda _what, _done, _total: None)
    points = _detect_all(settings, settings.calibration, "calibration", said)
    said("calibrating", 0, 1)
    start = time.perf_counter()
    calibration = settings.calibration
    rig = calibrate(
        points,
        control=inside(settings, calibration.control),
        model=calibration.model,
        volume_mm=calibration.volume_mm,
        accept_untrusted=calibration.accept_untrusted,
    )
    elapsed = time.perf_counter() - start
    said("calibrating", 1, 1)
    jobs = tuple(_run_job(settings, job, rig, said) for job in settings.job)
    overlays = _overlays(settings, calibration, points, rig)
    for job, done in zip(settings.job, jobs, strict=True):
        if len(overlays) < MAX_OVERLAYS and job.crops is None:
            overlays += _overlays(settings, job, done.points, None)
    return RunResult(folder, rig, jobs, (), elapsed), overlays[:MAX_OVERLAYS]


def _run_job(settings: Settings, job: Job, rig: Rig, said: Announce) -> JobResult:
    points = _detect_all(settings, job, job.name, said)
    positions = measure(rig, points)
    result: Result | None = None
    if job.verify is not None and job.truth is not None:
        truth = inside(settings, job.truth)
        result = verify(job.verify, positions, truth=truth, rig=rig)
    return JobResult(job.name, points, positions, result)


def _detect_all(settings: Settings, detection: Detection, what: str, said: Announce) -> ImagePoints:
    """Detect in the images of all cameras, after checking that they belong together."""
    paths = {name: images_of(settings, listed) for name, listed in detection.images.items()}
    sets = group_images(paths, pattern=detection.placement_pattern)
    check_duplicates(
        read_image(path, camera=camera) for one in sets for camera, path in one.paths.items()
    )
    total, before = sum(len(one.paths) for one in sets), 0
    found: ImagePoints | None = None
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
    return found


def _offset_progress(
    said: Announce, what: str, before: int, total: int
) -> Callable[[int, int], None]:
    return lambda done, _of: said(what, before + done, total)


def _overlays(
    settings: Settings, detection: Detection, points: ImagePoints, rig: Rig | None
) -> list[Overlay]:
    overlays = []
    for camera, patterns in detection.images.items():
        for path in sorted(images_of(settings, patterns), key=lambda file: natural_key(file.name)):
            placement, reading = placement_and_reading(path, detection.placement_pattern)
            if reading:
                continue
            overlays.append(
                make_overlay(
                    read_image(path, camera=camera),
                    points,
                    placement=placement,
                    residuals=None if rig is None else rig.residuals,
                )
            )
    return overlays


def _named_files(settings: Settings) -> list[str]:
    """List the tables and targets that the project names, as they are written there."""
    keys = ("target", "crops", "control", "truth")
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
    write_rig(result.rig, folder / "rig.json")
    documents: list[dict[str, Any]] = []
    for job in result.jobs:
        stem = job.name.replace(" ", "-")
        write_points(job.points, folder / f"{stem}-points.csv")
        write_positions(job.positions, folder / f"{stem}-positions.csv")
        if job.result is not None:
            write_result(job.result, folder / f"{stem}-result.json")
            documents.append({"job": job.name, **job.result.to_document()})
    document = {
        "schema": RUN_SCHEMA,
        "title": settings.title,
        "rig": rig_to_document(result.rig),
        "results": documents,
        "overlays": [overlay.to_document() for overlay in overlays],
        "warnings": list(result.warnings),
        "provenance": {"program": f"closerange {__version__}", "inputs": hashes},
    }
    dump_json(document, folder / "run.json")
    write_text(folder / "report.html", report_of_run(document, source="run.json"))
