"""The verb `match`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from closerange.apps.cli import options
from closerange.apps.cli.console import Outcome, keep, verb
from closerange.apps.cli.outputs import check_outputs
from closerange.apps.cli.progress import Progress
from closerange.errors import CloseRangeError, DataError, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from closerange.matching.correspondences import Correspondences
    from closerange.rig.rig import Rig
    from closerange.workflows.match import Matched, Wanted

ORIGINS = {
    "stated": "",
    "rig": ", the rig's; --z or --volume replaces it",
    "proposed": ", proposed as the rig's is flat; --z or --volume replaces it",
}
"""What is said of the volume in which matches were sought."""


@verb
def match(
    rig: options.RigFile,
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="NAME=IMAGE...",
            help="One image of each camera, two or more; points are those of the first.",
        ),
    ],
    output: Annotated[Path, options.output("matches.csv")],
    points: Annotated[
        Path | None,
        typer.Option(
            metavar="SEEDS.csv", help="Points to be found: rows of one camera, names are kept."
        ),
    ] = None,
    edges: Annotated[
        bool, typer.Option("--edges", help="All edge points; the default without --points.")
    ] = False,
    corners: Annotated[
        bool, typer.Option("--corners", help="Corners: where straight pieces of edges meet.")
    ] = False,
    z: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="MIN MAX",
            help="Z of the points, mm; lifts the limits of the rig's volume in X and Y.",
        ),
    ] = None,
    volume: Annotated[
        options.Corners | None,
        typer.Option(
            metavar="X Y Z X Y Z",
            help="Where the points are: lower and upper corner, mm; without it and --z the rig's "
            "measuring volume.",
        ),
    ] = None,
    placement: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Placement; with --points, the one whose rows are used."),
    ] = None,
    method: Annotated[
        str, typer.Option(help="default, or literal (the thesis' chapter 5, for comparison).")
    ] = "default",
    element: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="Side of the literal method's structuring element, px, odd (15)."
        ),
    ] = None,
    ply: Annotated[
        Path | None,
        typer.Option(metavar="wire.ply", help="Also write positions and edges in space."),
    ] = None,
    overlay: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Also write pictures into a new folder: edges, one element and its search, all "
            "matches by depth and by flag.",
        ),
    ] = None,
    _json: options.Json = False,
) -> Outcome:
    """Find points of one image in the images of other cameras."""
    from closerange.rig.rig_file import read_rig
    from closerange.workflows.match import Wanted
    from closerange.workflows.match_overlay import check_folder

    wanted = Wanted(
        points=points, edges=edges, corners=corners, z_mm=z, volume_mm=volume,
        placement=placement, method=method, element_px=element,  # type: ignore[arg-type]
    )  # fmt: skip
    cameras = read_rig(rig)
    named = _images(images, cameras)
    check_outputs([output, ply], [rig, points, *named.values()])
    if overlay is not None:
        check_folder(overlay)
    return _matched(cameras, named, wanted, output, ply=ply, overlay=overlay)


def _matched(
    rig: Rig,
    images: dict[str, str],
    wanted: Wanted,
    output: Path,
    *,
    ply: Path | None,
    overlay: Path | None,
) -> Outcome:
    """Match, and write what was asked for."""
    from closerange.matching.matches_table import write_matches
    from closerange.workflows.match import match_images
    from closerange.workflows.match_overlay import write_match_pictures
    from closerange.workflows.wire_frame import write_wire_frame

    with Progress("matching") as progress:
        matched = match_images(rig, images, wanted, progress=progress.step("matching"))
    write_matches(matched.matches, output)
    keep(output)
    summary = _summary(matched, output)
    if overlay is not None:
        pictures = write_match_pictures(rig, images, matched, overlay)
        summary |= {"overlay": [str(path) for path in pictures]}
    if ply is not None:
        drawn = write_wire_frame(rig, matched.matches, ply)
        summary |= {"ply": str(ply), "vertices": drawn.vertices, "lines": drawn.lines}
    return Outcome(_text(matched, output, ply, overlay), summary, failure=_failure(matched, output))


def _images(texts: Sequence[str], rig: Rig) -> dict[str, str]:
    """Read ``NAME=IMAGE`` arguments; a name or a path may itself contain the sign."""
    known = {camera.name for camera in rig.cameras}
    named: dict[str, str] = {}
    for text in texts:
        places = [place for place, sign in enumerate(text) if sign == "="]
        splits = [(text[:place], text[place + 1 :]) for place in places]
        splits = [split for split in splits if split[0] and split[1]]
        if not splits:
            raise InputError(
                f"{text!r}: expected NAME=IMAGE", remedy="for instance left=part_left.png"
            )
        name, path = next((split for split in splits if split[0] in known), splits[0])
        if name in named:
            raise InputError(
                f"camera {name!r} is given two images: {named[name]} and {path}",
                remedy="give one image of each camera",
            )
        named[name] = path
    return named


def _text(matched: Matched, output: Path, ply: Path | None, overlay: Path | None) -> str:
    from closerange.apps.cli.screens import box_text, flags_text, lines

    matches = matched.matches
    first, *others = matches.cameras
    return lines(
        ("Points", f"{int(matches.found[:, 0].sum())} of camera {first}"),
        ("Matched", f"{int(matches.clean.sum())} without a flag in {', '.join(others)}"),
        ("Flags", flags_text(matches.point_flags)),
        ("Volume", box_text(matched.volume_mm) + ORIGINS[matched.volume_origin]),
        ("Written", output),
        ("Wire frame", ply or ""),
        ("Pictures", overlay or ""),
    )


def _summary(matched: Matched, output: Path) -> dict[str, Any]:
    from closerange.apps.cli.screens import flag_counts

    matches = matched.matches
    return {
        "points": len(matches),
        "cameras": list(matches.cameras),
        "matched": int(matches.matched.sum()),
        "unflagged": int(matches.clean.sum()),
        "flags": flag_counts(matches.point_flags),
        "views": {name: _view(matches, column) for column, name in enumerate(matches.cameras)},
        "volume_mm": matched.volume_mm.tolist(),
        "volume_origin": matched.volume_origin,
        "doubt": matched.doubt,
        "output": str(output),
    }


def _view(matches: Correspondences, column: int) -> dict[str, int]:
    found = matches.found[:, column]
    return {
        "found": int(found.sum()),
        "unflagged": int((found & (matches.flags[:, column] == 0)).sum()),
    }


def _failure(matched: Matched, output: Path) -> CloseRangeError | None:
    """Say why the exit code is 1 although a table is written."""
    from closerange.workflows.match_doubt import EVIDENT, OTHERWISE, evident_flag, flags_of

    matches = matched.matches
    if matched.doubt:
        return DataError(
            f"{matched.doubt}; all matches in {output} are flagged",
            remedy=f"{matched.remedy}; the table is written to be looked at",
        )
    if matches.clean.any():
        return None
    some = ", ".join(f"{count} {flag.name}" for flag, count in flags_of(matches)[:3])
    why = evident_flag(matches)
    return DataError(
        f"none of the {len(matches)} points in {output} has a match without a flag ({some})",
        remedy=OTHERWISE if why is None else EVIDENT[why],
    )
