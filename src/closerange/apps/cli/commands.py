"""The verbs of the command line, as DESIGN section 5 writes them."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from closerange.apps.cli import options
from closerange.apps.cli.console import Outcome, keep, verb
from closerange.apps.cli.examples import epilog
from closerange.apps.cli.outputs import check_outputs
from closerange.apps.cli.progress import Progress
from closerange.apps.cli.usage import Verbs
from closerange.errors import DataError
from closerange.version import __version__

if TYPE_CHECKING:
    from closerange.workflows.run import RunResult

app = typer.Typer(
    name="closerange",
    cls=Verbs,
    help="Close-range 3-D position sensing with two or more ordinary cameras placed anywhere.\n\n"
    "Begin with: closerange demo",
    invoke_without_command=True,
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
    context: typer.Context,
    _: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Close-range 3-D position sensing with two or more ordinary cameras placed anywhere."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        raise typer.Exit(2)  # nothing was asked for, nothing is done


@app.command(epilog=epilog("detect"))
@verb
def detect(
    images: options.ImageFiles,
    target: Annotated[str, typer.Option(metavar="TARGET.toml", help="What to look for.")],
    camera: options.Camera,
    output: Annotated[Path, options.output("points.csv")],
    placement: options.Placement = None,
    placement_pattern: options.PlacementPattern = None,
    estimator: Annotated[
        str, typer.Option(help="least-squares, or border-centroid (the thesis' eq. 2.7).")
    ] = "least-squares",
    crops: Annotated[
        str | None,
        typer.Option(
            metavar="CROPS.csv", help="image, x0_px, y0_px of images cut out of larger ones."
        ),
    ] = None,
    _json: options.Json = False,
) -> Outcome:
    """Find a target in the images of one camera. Several images are several placements."""
    from closerange.apps.cli.screens import points_summary, points_text
    from closerange.features.points_table import write_points
    from closerange.workflows.detect import detect as work

    check_outputs([output], [*images, target, crops])
    with Progress() as progress:
        points = work(
            images, target=target, camera=camera, placement=placement,
            placement_pattern=placement_pattern, estimator=estimator, crops=crops,
            progress=progress.step("detecting"),
        )  # fmt: skip
    write_points(points, output)
    failure = None if (points.flags == 0).any() else _all_flagged(len(points), output)
    return Outcome(points_text(points, output), points_summary(points, output), failure=failure)


@app.command(epilog=epilog("calibrate"))
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
        options.Corners | None,
        typer.Option(metavar="X Y Z X Y Z", help="Measuring volume: lower and upper corner, mm."),
    ] = None,
    accept_untrusted: Annotated[
        bool, typer.Option("--accept-untrusted", help="Write an untrustworthy rig, marked so.")
    ] = False,
    times: options.Times = None,
    time_tolerance: options.TimeTolerance = None,
    report: options.Report = None,
    _json: options.Json = False,
) -> Outcome:
    """Calibrate cameras to the world frame of known points."""
    from closerange.apps.cli.screens import rig_summary, rig_text
    from closerange.files import write_text
    from closerange.rig.rig_file import write_rig
    from closerange.workflows.calibrate import calibrate as work
    from closerange.workflows.report import report_of_rig

    check_outputs([output, report], [*points, control, times])
    options.check_times(points, times, time_tolerance)
    with Progress("calibrating") as progress:
        rig = work(
            points, control=control, image_size=options.image_sizes(image_size), model=model,
            volume_mm=volume, free_poses=free_poses, accept_untrusted=accept_untrusted,
            progress=progress.step("calibrating"),
        )  # fmt: skip
        page = None if report is None else report_of_rig(rig)
    write_rig(rig, output)
    keep(output)
    if report is not None and page is not None:
        write_text(report, page)
    return Outcome(rig_text(rig, output, report), rig_summary(rig, output))


@app.command(epilog=epilog("measure"))
@verb
def measure(
    rig: options.RigFile,
    points: Annotated[list[Path], typer.Argument(metavar="POINTS.csv...", help="Points tables.")],
    output: Annotated[Path, options.output("positions.csv")],
    times: options.Times = None,
    time_tolerance: options.TimeTolerance = None,
    _json: options.Json = False,
) -> Outcome:
    """Measure world positions of points that two or more cameras see."""
    from closerange.apps.cli.screens import positions_summary, positions_text
    from closerange.position.positions_table import write_positions
    from closerange.position.suspicion import REMEDY, DoubtWarning
    from closerange.workflows.measure import measure as work

    check_outputs([output], [rig, *points, times])
    options.check_times(points, times, time_tolerance)
    with Progress("measuring"), warnings.catch_warnings():
        warnings.simplefilter("ignore", DoubtWarning)  # said below, as the reason of exit code 1
        positions = work(rig, points)
        write_positions(positions, output)
    failure = None if (positions.flags == 0).any() else _all_flagged(len(positions), output)
    failure = DataError(positions.doubt, remedy=REMEDY) if positions.doubt else failure
    text, summary = positions_text(positions, output), positions_summary(positions, output)
    return Outcome(text, summary, failure=failure)


@app.command(epilog=epilog("verify"))
@verb
def verify(
    kind: Annotated[
        str, typer.Argument(metavar="KIND", help="control, single-point, lengths or heights.")
    ],
    positions: Annotated[Path, typer.Argument(metavar="POSITIONS.csv", help="What was measured.")],
    truth: Annotated[
        Path, typer.Option(metavar="TABLE.csv", help="Known positions, lengths or parts.")
    ],
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
    confidence: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="How sure a decision must be, from 0.5 to below 1 (0.95); with limits.",
        ),
    ] = None,
    cycle_time: Annotated[
        float | None, typer.Option(metavar="SECONDS", help="Time from command to result.")
    ] = None,
    report: options.Report = None,
    _json: options.Json = False,
) -> Outcome:
    """Compare positions with a known truth."""
    from closerange.apps.cli.screens import result_failure, result_summary, result_text
    from closerange.files import write_text
    from closerange.verification.result_file import read_result, write_result
    from closerange.workflows.inputs import input_hashes, versions
    from closerange.workflows.report import report_of_result
    from closerange.workflows.verify import verify as work

    check_outputs([output, report], [positions, truth, rig])
    with Progress("comparing"):
        result = work(
            kind, positions, truth=truth, rig=rig, cycle_time_s=cycle_time,
            limits=options.limits(accuracy_limit, repeatability_limit, confidence),
        )  # fmt: skip
    inputs = input_hashes([path for path in (positions, truth, rig) if path is not None])
    provenance = {**versions(), "inputs": inputs}
    write_result(result, output, provenance=provenance)
    keep(output)
    if report is not None:
        write_text(report, report_of_result(read_result(output)))
    text, summary = result_text(result, output, report), result_summary(result, output)
    return Outcome(text, summary, failure=result_failure(result))


@app.command(epilog=epilog("run"))
@verb
def run(
    project: Annotated[Path, typer.Argument(metavar="PROJECT.toml", help="Project file.")],
    output: Annotated[
        Path | None, typer.Option("--output", metavar="DIR", help="Folder of the results.")
    ] = None,
    overwrite: options.Overwrite = False,
    _json: options.Json = False,
) -> Outcome:
    """Run a project: detect, calibrate, measure, verify, report."""
    from closerange.apps.cli.screens import run_text
    from closerange.workflows.run import run as work

    with Progress() as progress:
        result = work(project, output=output, overwrite=overwrite, announce=progress.announce)
    return _outcome_of_run(result, run_text(result))


@app.command(epilog=epilog("demo"))
@verb
def demo(
    output: Annotated[
        Path, typer.Option("--output", metavar="DIR", help="Folder of the results.")
    ] = Path("closerange-demo"),
    overwrite: options.Overwrite = False,
    _json: options.Json = False,
) -> Outcome:
    """Run the whole chain on shipped images; no network, no camera."""
    from closerange.apps.cli.screens import demo_text
    from closerange.workflows.demo import demo as work

    with Progress() as progress:
        result = work(output, overwrite=overwrite, announce=progress.announce)
    return _outcome_of_run(result, demo_text(result))


@app.command(epilog=epilog("report"))
@verb
def report(
    source: Annotated[
        Path, typer.Argument(metavar="RESULT.json", help="A rig, a result or a run.json.")
    ],
    output: Annotated[Path, options.output("report.html")],
    _json: options.Json = False,
) -> Outcome:
    """Render a stored result again, as one HTML file."""
    from closerange.files import write_text
    from closerange.workflows.report import report as work

    check_outputs([output], [source])
    with Progress("rendering"):
        write_text(output, work(source))
    return Outcome(f"Report       {output}", {"report": str(output)})


def _outcome_of_run(result: RunResult, text: str) -> Outcome:
    from closerange.apps.cli.screens import run_failure, run_summary

    failure = run_failure(result)
    return Outcome(text, run_summary(result), notes=result.warnings, failure=failure)


def _all_flagged(rows: int, output: Path) -> DataError:
    """Say why the exit code is 1 although a table is written."""
    return DataError(
        f"none of the {rows} rows in {output} is free of flags",
        remedy="the column flags says why; the table is written to be looked at, not relied on",
    )
