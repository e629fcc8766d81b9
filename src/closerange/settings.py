"""The project file ``closerange.toml``: one whole job, as frozen settings.

Paths are relative to the project file and stay inside its folder. ::

    schema = "closerange.project/1"
    title = "Plate at seven heights"

    [calibration]
    target = "plate.toml"
    control = "control.csv"
    placement_pattern = "z(.*)$"
    images = { left = ["calibration/left_*.png"], right = ["calibration/right_*.png"] }

    [[job]]
    name = "single-point"
    target = "disc.toml"
    placement_pattern = "p(?P<placement>[0-9]+)_(left|right)_r(?P<reading>[0-9]+)$"
    images = { left = ["verify/*_left_*.png"], right = ["verify/*_right_*.png"] }
    crops = "verify/crops.csv"
    verify = "single-point"
    truth = "verify/truth.csv"
    limits = { accuracy_mm = [0.01, 0.01, 0.03], repeatability_mm = 0.01 }

    [[job]]
    name = "blocks"
    match = "edges"
    images = { left = ["blocks/left.png"], right = ["blocks/right.png"] }
    z_mm = [-52.0, 28.0]
    verify = "heights"
    truth = "blocks/parts.csv"
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    model_validator,
)

from closerange.errors import FileError, SchemaError
from closerange.files import read_text

SCHEMA = "closerange.project/1"

Name = Annotated[str, Field(min_length=1)]
Estimator = Literal["least-squares", "border-centroid"]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
PerAxis = Positive | Annotated[list[Positive], Field(min_length=3, max_length=3)]


class _Table(BaseModel):
    """A table of the project file: frozen, without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Detection(_Table):
    """What to look for in which images.

    Attributes
    ----------
    target : str
        Target file.
    images : dict of str to list of str
        Camera name: glob patterns of its image files.
    placement_pattern : str or None
        How a file name gives the placement and the reading; see `closerange detect`.
    crops : str or None
        CSV file with ``image, x0_px, y0_px`` for images cut out of larger ones.
    estimator : str
        ``least-squares`` or ``border-centroid``.
    times : str or None
        CSV file with ``camera, placement, time_s`` and optionally ``reading``: when the images
        were taken.
    time_tolerance_s : float or None
        Largest time between the cameras' images of one placement.
    """

    target: Name
    images: dict[Name, list[Name]]
    placement_pattern: str | None = None
    crops: Name | None = None
    estimator: Estimator = "least-squares"
    times: Name | None = None
    time_tolerance_s: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None

    @model_validator(mode="after")
    def _times_need_a_tolerance(self) -> Self:
        if (self.times is None) != (self.time_tolerance_s is None):
            raise ValueError("times and time_tolerance_s go together")
        return self


class Calibration(Detection):
    """How the rig is calibrated.

    Attributes
    ----------
    control : str
        Control table.
    model : str
        As ``closerange calibrate --model``.
    volume_mm : list of float or None
        Six numbers: lower corner, upper corner.
    accept_untrusted : bool
        Go on with an untrustworthy rig, marked so.
    """

    control: Name
    model: Name = "auto"
    volume_mm: Annotated[list[float], Field(min_length=6, max_length=6)] | None = None
    accept_untrusted: bool = False


class JobLimits(_Table):
    """Largest figures that the buyer accepts; with them a single-point test decides.

    Attributes
    ----------
    accuracy_mm, repeatability_mm : float, list of float or None
        One number for all axes, or three; see `closerange.verification.judgement.Limits`.
    cycle_time_s : float or None
        Of the program's own time for a reading, from the images on disk to the position. A clock
        then has a part in the results: they are no longer the same byte for byte in every run.
    confidence : float
        Probability with which a decision is right at the very limit; sets the guard bands.
    """

    accuracy_mm: PerAxis | None = None
    repeatability_mm: PerAxis | None = None
    cycle_time_s: Positive | None = None
    confidence: Annotated[float, Field(ge=0.5, lt=1)] = 0.95

    @model_validator(mode="after")
    def _something_is_limited(self) -> Self:
        if (self.accuracy_mm, self.repeatability_mm, self.cycle_time_s) == (None, None, None):
            raise ValueError("limits without any limit; remove them or state one")
        return self


class Job(Detection):
    """Something to measure and, if a truth is known, to verify.

    Attributes
    ----------
    name : str
        Names its output files.
    verify : str or None
        ``control``, ``single-point`` or ``lengths``.
    truth : str or None
        Table of true positions or lengths.
    limits : JobLimits or None
        What a ``single-point`` test must keep.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$")]
    verify: Literal["control", "single-point", "lengths"] | None = None
    truth: Name | None = None
    limits: JobLimits | None = None

    @model_validator(mode="after")
    def _verify_needs_truth(self) -> Job:
        if (self.verify is None) != (self.truth is None):
            raise ValueError("verify and truth go together")
        if self.limits is not None and self.verify != "single-point":
            raise ValueError('limits are those of verify = "single-point"')
        return self


class MatchJob(_Table):
    """A scene without a target: points of one image are found in the others and measured.

    Attributes
    ----------
    name : str
        Names its output files.
    match : str
        ``edges``, ``corners``, ``centroids`` (of bright faces) or ``points``.
    images : dict of str to list of str
        Camera name: its one image. The points are those of the first camera, unless `points` are
        of another.
    points : str or None
        Points table, with ``match = "points"`` only.
    z_mm : list of float or None
        Least and largest Z of the points; lifts the limits of the rig's volume in X and Y.
    volume_mm : list of float or None
        Where the points are instead: lower corner, upper corner.
    method : str
        ``default`` or ``literal``.
    element_px : int or None
        Side of the literal method's structuring element.
    verify : str or None
        ``heights`` of parts, or ``control`` for points by name.
    truth : str or None
        Table of parts, or control table.
    """

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._-]*$")]
    match: Literal["edges", "corners", "centroids", "points"]
    images: Annotated[dict[Name, list[Name]], Field(min_length=2)]
    points: Name | None = None
    z_mm: Annotated[list[float], Field(min_length=2, max_length=2)] | None = None
    volume_mm: Annotated[list[float], Field(min_length=6, max_length=6)] | None = None
    method: Literal["default", "literal"] = "default"
    element_px: int | None = None
    verify: Literal["heights", "control"] | None = None
    truth: Name | None = None

    @model_validator(mode="after")
    def _belongs_together(self) -> Self:
        if (self.verify is None) != (self.truth is None):
            raise ValueError("verify and truth go together")
        if (self.match == "points") != (self.points is not None):
            raise ValueError('points go with match = "points"')
        if self.z_mm is not None and self.volume_mm is not None:
            raise ValueError("z_mm and volume_mm exclude each other")
        return self


def _kind_of_job(job: Any) -> str:
    """Tell a job that matches from one that detects a target."""
    matches = "match" in job if isinstance(job, dict) else isinstance(job, MatchJob)
    return "a scene" if matches else "a target"


AnyJob = Annotated[
    Annotated[Job, Tag("a target")] | Annotated[MatchJob, Tag("a scene")],
    Discriminator(_kind_of_job),
]


class Outputs(_Table):
    """Where results go.

    Attributes
    ----------
    folder : str
        Created by the run; an existing one is only replaced when told so.
    """

    folder: Name = "results"


class Settings(_Table):
    """A project file.

    Attributes
    ----------
    folder : Path
        Folder of the project file.
    schema_ : str
        ``closerange.project/1``, written as ``schema``.
    title : str
        For reports.
    calibration : Calibration
        How the rig is calibrated.
    job : list of Job or MatchJob
        What is measured.
    outputs : Outputs
        Where results go.
    """

    folder: Path
    schema_: Literal["closerange.project/1"] = Field(alias="schema")
    title: Name = "Close-range measurement"
    calibration: Calibration
    job: list[AnyJob] = []
    outputs: Outputs = Outputs()

    @model_validator(mode="after")
    def _jobs_write_different_files(self) -> Settings:
        names = [job.name.replace(" ", "-").casefold() for job in self.job]
        if len(set(names)) < len(names):
            raise ValueError("two jobs would write the same files; give each job its own name")
        if "calibration" in names:
            raise ValueError("a job called calibration would write the calibration's own files")
        return self


def read_settings(path: Path | str) -> Settings:
    """Read a project file.

    Parameters
    ----------
    path : Path or str
        TOML file.

    Returns
    -------
    Settings
        Checked, except that its files exist.

    Raises
    ------
    FileError
        If the file cannot be read.
    SchemaError
        If it is not TOML, or a key is unknown, missing or of the wrong kind.
    """
    path = Path(path)
    try:
        document = tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise SchemaError(f"{path}: {error}", remedy="correct the TOML") from error
    except RecursionError as error:
        raise SchemaError(f"{path}: nested too deeply", remedy="this is no project file") from error
    if "folder" in document:
        raise SchemaError(f"{path}: folder: unknown key", remedy="remove it")
    try:
        return Settings.model_validate({**document, "folder": path.parent})
    except ValidationError as error:
        first = error.errors()[0]
        place = [str(part) for part in first["loc"] if part not in ("a target", "a scene")]
        where = ".".join(place) or "project"
        raise SchemaError(
            f"{path}: {where}: {first['msg']}", remedy="see 'Project file' in the documentation"
        ) from error


def inside(settings: Settings, relative: str) -> Path:
    """Resolve a path of the project file.

    Parameters
    ----------
    settings : Settings
        The project.
    relative : str
        Path as written.

    Returns
    -------
    Path
        The file below the project's folder.

    Raises
    ------
    FileError
        If it is absolute, climbs out of the folder, or leaves it through a symbolic link.
    """
    written = Path(relative)
    if written.is_absolute() or ".." in written.parts:
        raise FileError(
            f"{relative}: leaves the project's folder", remedy="put the file below the project file"
        )
    path = settings.folder / written
    try:
        within = path.resolve().is_relative_to(settings.folder.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, a NUL byte
        raise FileError(f"{relative!r}: {error}", remedy="correct the path") from error
    if not within:
        raise FileError(
            f"{relative}: a symbolic link leaves the project's folder",
            remedy="put the file itself below the project file",
        )
    return path


def images_of(settings: Settings, patterns: list[str]) -> list[Path]:
    """Find the image files of glob patterns, in natural order by the caller.

    Parameters
    ----------
    settings : Settings
        The project.
    patterns : list of str
        File names, or patterns with ``*`` and ``?`` in their last part.

    Returns
    -------
    list of Path
        Existing files.

    Raises
    ------
    FileError
        If a pattern finds nothing or leaves the project's folder.
    """
    found: list[Path] = []
    for pattern in patterns:
        inside(settings, pattern)  # its message shows the pattern as it is written
        folder, name = inside(settings, str(Path(pattern).parent)), Path(pattern).name
        matches = sorted(folder.glob(name)) if name and folder.is_dir() else []
        if not matches:
            raise FileError(f"{pattern}: no such file in the project", remedy="correct the pattern")
        found.extend(inside(settings, str(match.relative_to(settings.folder))) for match in matches)
    return found
