"""Options that several verbs share, and how their texts are read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from closerange.errors import InputError

if TYPE_CHECKING:
    from closerange.verification.judgement import Limits

Json = Annotated[bool, typer.Option("--json", help="Print a machine-readable summary on stdout.")]
Report = Annotated[
    Path | None, typer.Option("--report", metavar="report.html", help="Also write a report.")
]
Times = Annotated[
    Path | None,
    typer.Option(
        metavar="TIMES.csv",
        help="When the images were taken (camera, placement, time_s); needs --time-tolerance.",
    ),
]
TimeTolerance = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS", help="Largest time between the cameras' images of one placement."
    ),
]
Placement = Annotated[
    str | None, typer.Option("--placement", metavar="NAME", help="Placement; with one image only.")
]
PlacementPattern = Annotated[
    str | None,
    typer.Option(
        "--placement-pattern",
        metavar="REGEX",
        help="Searched in the file's stem: group 1 names the placement, a group named 'reading' "
        "the repeated reading.",
    ),
]
Camera = Annotated[
    str, typer.Option("--camera", metavar="NAME", help="Camera that took the images.")
]
RigFile = Annotated[Path, typer.Argument(metavar="RIG.json", help="Calibrated cameras.")]
ImageFiles = Annotated[list[str], typer.Argument(metavar="IMAGE...", help="Images or folders.")]
Corners = tuple[float, float, float, float, float, float]
"""Lower and upper corner of a box: X Y Z X Y Z in mm."""

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace an existing folder of results.")
]


def output(example: str) -> Any:
    """Return the option ``-o FILE``, shown with an example of a name."""
    return typer.Option(
        "-o", "--output", metavar=example, help="File to write; replaced whole or not at all."
    )


def image_sizes(texts: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Read ``NAME=WxH`` options.

    Parameters
    ----------
    texts : sequence of str
        One for each camera.

    Returns
    -------
    dict of str to (int, int)
        Width and height in px by camera.

    Raises
    ------
    InputError
        If a text has another form, or a camera is named twice.
    """
    sizes: dict[str, tuple[int, int]] = {}
    for text in texts:
        name, _, size = text.rpartition("=")
        match = re.fullmatch(r"([1-9]\d{0,5})x([1-9]\d{0,5})", size, re.ASCII)
        if not name or not match:
            raise InputError(
                f"--image-size {text!r}: expected NAME=WxH",
                remedy="for instance --image-size left=1280x1024",
            )
        if name in sizes:
            raise InputError(
                f"--image-size names camera {name!r} twice", remedy="give one size for each camera"
            )
        sizes[name] = int(match[1]), int(match[2])
    return sizes


def limits(
    accuracy_mm: tuple[float, float, float] | None,
    repeatability_mm: tuple[float, float, float] | None,
    confidence: float | None,
) -> Limits | None:
    """Put permissible errors together; None if none is given."""
    if accuracy_mm is None and repeatability_mm is None:
        if confidence is not None:
            raise InputError(
                "--confidence was given without limits to decide about",
                remedy="give --accuracy-limit or --repeatability-limit too",
            )
        return None
    from closerange.verification.judgement import CONFIDENCE, Limits

    return Limits.of(
        accuracy_mm=accuracy_mm,
        repeatability_mm=repeatability_mm,
        confidence=CONFIDENCE if confidence is None else confidence,
    )


def check_times(points: Sequence[Path], times: Path | None, tolerance_s: float | None) -> None:
    """Refuse points of images that were not taken together, if it is told when they were.

    Parameters
    ----------
    points : sequence of Path
        Points tables.
    times : Path or None
        Table of exposure times.
    tolerance_s : float or None
        Largest time between the cameras of one placement, in seconds.

    Raises
    ------
    InputError
        If one option is given without the other, or images were taken further apart.
    """
    if times is None and tolerance_s is None:
        return
    if times is None or tolerance_s is None:
        raise InputError(
            f"{'--time-tolerance' if times is None else '--times'} was given alone",
            remedy="give --times TIMES.csv and --time-tolerance SECONDS together; at v mm/s an "
            "object moves v x SECONDS mm meanwhile",
        )
    from closerange.workflows.times import require_simultaneous

    require_simultaneous(points, times=times, tolerance_s=tolerance_s)
