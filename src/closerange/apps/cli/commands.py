"""The verbs of the command line, as DESIGN section 5 writes them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from closerange.apps.cli import options
from closerange.apps.cli.console import Progress, print_json, say, verb
from closerange.version import __version__

app = typer.Typer(
    name="closerange",
    help="Close-range 3-D position sensing with two or more ordinary cameras placed anywhere.\n\n"
    "Begin with: closerange demo",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"closerange {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Close-range 3-D position sensing with two or more ordinary cameras placed anywhere."""


@app.command(epilog="Example: closerange detect left_*.png --target plate.toml --camera left "
             "--placement-pattern '_(z.*)$' -o left.csv")  # fmt: skip
@verb
def detect(
    images: Annotated[list[str], typer.Argument(metavar="IMAGE...", help="Images or folders.")],
    target: Annotated[str, typer.Option(metavar="TARGET.toml", help="What to look for.")],
    camera: Annotated[str, typer.Option(metavar="NAME", help="Camera that took the images.")],
    output: Annotated[Path, options.output("points.csv")],
    placement: Annotated[
        str | None, typer.Option(metavar="NAME", help="Placement; with one image only.")
    ] = None,
    placement_pattern: Annotated[
        str | None,
        typer.Option(
            metavar="REGEX",
            help="Searched in the file's stem: group 1 names the placement, a group named "
            "'reading' the repeated reading.",
        ),
    ] = None,
    estimator: Annotated[
        str, typer.Option(help="least-squares, or border-centroid (the thesis' eq. 2.7).")
    ] = "least-squares",
    crops: Annotated[
        str | None,
        typer.Option(
            metavar="CROPS.csv", help="image, x0_px, y0_px of images cut out of larger ones."
        ),
    ] = None,
    json_output: options.Json = False,
) -> int:
    """Find a target in the images of one camera; several images are several placements."""
    from closerange.apps.cli.screens import points_summary, points_text
    from closerange.features.points_table import write_points
    from closerange.workflows.detect import detect as work

    with Progress() as progress:
        points = work(
            images, target=target, camera=camera, placement=placement,
            placement_pattern=placement_pattern, estimator=estimator, crops=crops,
            progress=progress.step("detecting"),
        )  # fmt: skip
    write_points(points, output)
    say(points_text(points, output), json_output=json_output)
    if json_output:
        print_json(points_summary(points, output))
    return 0 if (points.flags == 0).any() else 1


@app.command(epilog="Example: closerange calibrate left.csv right.csv --control control.csv "
             "--image-size left=640x512 --image-size right=640x512 -o rig.json")  # fmt: skip
@verb
def calibrate(
    points: Annotated[list[Path], typer.Argument(metavar="POINTS.csv...", help="Points tables.")],
    control: Annotated[Path, typer.Option(metavar="CONTROL.csv", help="Known world points.")],
    output: Annotated[Path, options.output("rig.json")],
    image_size: Annotated[
        list[str], typer.Option(metavar="NAME=WxH", help="Image size; once for each camera.")
    ],
    model: Annotated[
        str,
        typer.Option(
            help="auto, brown, pinhole, brown-k1, brown-k1k2, dlt, thesis-dlt, thesis-distortion."
        ),
    ] = "auto",
    free_poses: Annotated[
        bool,
        typer.Option("--free-poses", help="Placements unknown; control in the target's frame."),
    ] = False,
    volume: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="X Y Z X Y Z", help="Measuring volume: lower and upper corner, mm."),
    ] = None,
    accept_untrusted: Annotated[
        bool, typer.Option("--accept-untrusted", help="Write an untrustworthy rig, marked so.")
    ] = False,
    report: options.Report = None,
    json_output: options.Json = False,
) -> int:
    """Calibrate cameras to the world frame of known points."""
    from closerange.apps.cli.screens import rig_summary, rig_text
    from closerange.files import write_text
    from closerange.rig.rig_file import write_rig
    from closerange.workflows.calibrate import calibrate as work
    from closerange.workflows.report import report_of_rig

    rig = work(
        points, control=control, image_size=options.image_sizes(image_size), model=model,
        volume_mm=volume, free_poses=free_poses, accept_untrusted=accept_untrusted,
    )  # fmt: skip
    write_rig(rig, output)
    if report is not None:
        write_text(report, report_of_rig(rig))
    say(rig_text(rig, output, report), json_output=json_output)
    if json_output:
        print_json(rig_summary(rig, output))
    return 0


@app.command(epilog="Example: closerange measure rig.json left.csv right.csv -o positions.csv")
@verb
def measure(
    rig: Annotated[Path, typer.Argument(metavar="RIG.json", help="Calibrated cameras.")],
    points: Annotated[list[Path], typer.Argument(metavar="POINTS.csv...", help="Points tables.")],
    output: Annotated[Path, options.output("positions.csv")],
    json_output: options.Json = False,
) -> int:
    """Measure world positions of points that two or more cameras see."""
    from closerange.apps.cli.screens import positions_summary, positions_text
    from closerange.position.positions_table import write_positions
    from closerange.workflows.measure import measure as work

    positions = work(rig, points)
    write_positions(positions, output)
    say(positions_text(positions, output), json_output=json_output)
    if json_output:
        print_json(positions_summary(positions, output))
    return 0 if (positions.flags == 0).any() else 1


@app.command(epilog="Example: closerange verify single-point positions.csv --truth truth.csv "
             "-o result.json --report report.html")  # fmt: skip
@verb
def verify(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="control, single-point or lengths.")],
    positions: Annotated[Path, typer.Argument(metavar="POSITIONS.csv", help="What was measured.")],
    truth: Annotated[Path, typer.Option(metavar="TABLE.csv", help="Known positions or lengths.")],
    output: Annotated[Path, options.output("result.json")],
    rig: Annotated[
        Path | None,
        typer.Option(
            metavar="RIG.json", help="Tells fitted from check points, inside from outside."
        ),
    ] = None,
    accuracy_limit: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Permissible error of a position, mm (single-point)."),
    ] = None,
    repeatability_limit: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Permissible standard deviation, mm (single-point)."),
    ] = None,
    cycle_time: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Time from command to result.")
    ] = None,
    report: options.Report = None,
    json_output: options.Json = False,
) -> int:
    """Compare positions with a known truth."""
    from closerange.apps.cli.screens import result_summary, result_text
    from closerange.files import sha256, write_text
    from closerange.verification.result_file import read_result, write_result
    from closerange.workflows.report import report_of_result
    from closerange.workflows.verify import verify as work

    result = work(
        kind, positions, truth=truth, rig=rig, cycle_time_s=cycle_time,
        limits=options.limits(accuracy_limit, repeatability_limit),
    )  # fmt: skip
    inputs = {path.name: sha256(path) for path in (positions, truth, rig) if path is not None}
    provenance = {"program": f"closerange {__version__}", "inputs": inputs}
    write_result(result, output, provenance=provenance)
    if report is not None:
        write_text(report, report_of_result(read_result(output)))
    say(result_text(result, output, report), json_output=json_output)
    if json_output:
        print_json(result_summary(result, output))
    return 0


@app.command(epilog="Example: closerange run closerange.toml")
@verb
def run(
    project: Annotated[Path, typer.Argument(metavar="PROJECT.toml", help="Project file.")],
    output: Annotated[
        Path | None, typer.Option("--output", metavar="DIR", help="Folder of the results.")
    ] = None,
    overwrite: options.Overwrite = False,
    json_output: options.Json = False,
) -> int:
    """Run a project: detect, calibrate, measure, verify, report."""
    from closerange.apps.cli.screens import run_summary, run_text
    from closerange.workflows.run import run as work

    with Progress() as progress:
        result = work(project, output=output, overwrite=overwrite, announce=progress.announce)
    for note in result.warnings:
        say(f"warning: {note}", json_output=True)
    say(run_text(result), json_output=json_output)
    if json_output:
        print_json(run_summary(result))
    return 0


@app.command(epilog="Example: closerange demo --output closerange-demo")
@verb
def demo(
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder of the results.")
    ] = Path("closerange-demo"),
    overwrite: options.Overwrite = False,
    json_output: options.Json = False,
) -> int:
    """Run the whole chain on shipped images; no network, no camera."""
    from closerange.apps.cli.screens import demo_text, run_summary
    from closerange.workflows.demo import demo as work

    with Progress() as progress:
        result = work(output, overwrite=overwrite, announce=progress.announce)
    for note in result.warnings:
        say(f"warning: {note}", json_output=True)
    say(demo_text(result), json_output=json_output)
    if json_output:
        print_json(run_summary(result))
    return 0


@app.command(epilog="Example: closerange report rig.json -o report.html")
@verb
def report(
    source: Annotated[
        Path, typer.Argument(metavar="RESULT.json", help="A rig, a result or a run.json.")
    ],
    output: Annotated[Path, options.output("report.html")],
    json_output: options.Json = False,
) -> int:
    """Render a stored result again, as one HTML file."""
    from closerange.files import write_text
    from closerange.workflows.report import report as work

    write_text(output, work(source))
    say(f"Report       {output}", json_output=json_output)
    if json_output:
        print_json({"report": str(output)})
    return 0
