"""The verbs `shapes teach` and `shapes find`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from closerange.apps.cli import options
from closerange.apps.cli.console import Outcome, verb
from closerange.apps.cli.examples import epilog
from closerange.apps.cli.outputs import check_outputs
from closerange.apps.cli.progress import Progress
from closerange.errors import DataError, InputError

app = typer.Typer(
    name="shapes",
    help="Teach flat shapes from an image, and find them in others (Crimmins and Brown).",
    rich_markup_mode=None,
)


@app.command(epilog=epilog("shapes teach"))
@verb
def teach(
    image: Annotated[Path, typer.Argument(metavar="IMAGE", help="Image with the part lying free.")],
    name: Annotated[str, typer.Option(metavar="NAME", help="Name of the shape.")],
    at: Annotated[
        tuple[float, float], typer.Option(metavar="X Y", help="A place on the shape, px.")
    ],
    output: Annotated[Path, options.output("shapes.json")] = Path("shapes.json"),
    polarity: Annotated[
        str | None,
        typer.Option(help="bright or dark against its background; else what stands out more."),
    ] = None,
    margin: Annotated[
        float | None,
        typer.Option(
            metavar="PX",
            help="Half-width of the band at the border that is not looked "
            "at (2 px); shapes that differ by less are taken for each other.",
        ),
    ] = None,
    rotations: Annotated[
        float | None,
        typer.Option(metavar="DEGREES", help="Find it at other rolls too, in such steps."),
    ] = None,
    add: Annotated[
        bool, typer.Option("--add", help="Keep the other shapes of an existing file.")
    ] = False,
    _json: options.Json = False,
) -> Outcome:
    """Teach a shape: the region that stands out most around a place."""
    from closerange.apps.cli.screens import lines
    from closerange.features.shapes import MARGIN_PX, POLARITIES
    from closerange.features.shapes_file import read_shapes, write_shapes
    from closerange.workflows.shapes import teach_shape as work

    check_outputs([output], [image])
    known = {kind: kind for kind in POLARITIES}
    if polarity is not None and polarity not in known:
        raise InputError(f"--polarity {polarity!r}", remedy="write bright or dark")
    others = read_shapes(output) if add and output.exists() else ()
    shape = work(
        image, name=name, at_px=at, polarity=known[polarity] if polarity else None,
        margin_px=MARGIN_PX if margin is None else margin, rotation_step_deg=rotations,
    )  # fmt: skip
    kept = [other for other in others if other.name != shape.name]
    write_shapes([*kept, shape], output)
    height, width = shape.mask.shape
    summary: dict[str, Any] = {
        "name": shape.name,
        "polarity": shape.polarity,
        "size_px": [width, height],
        "area_px": int(shape.mask.sum()),
        "contrast": shape.contrast,
        "sharpness": shape.sharpness,
        "shapes": [other.name for other in kept] + [shape.name],
        "output": str(output),
    }
    text = lines(
        ("Shape", f"{name}: {shape.polarity}, {width} x {height} px"),
        ("Stands out", f"by {shape.contrast:g} grey levels"),
        ("Written", f"{output}: {', '.join(summary['shapes'])}"),
    )
    return Outcome(text, summary)


@app.command(epilog=epilog("shapes find"))
@verb
def find(
    images: options.ImageFiles,
    shapes: Annotated[Path, typer.Option(metavar="SHAPES.json", help="Taught shapes.")],
    camera: options.Camera,
    output: Annotated[Path, options.output("points.csv")],
    placement: options.Placement = None,
    placement_pattern: options.PlacementPattern = None,
    _json: options.Json = False,
) -> Outcome:
    """Find taught shapes in the images of one camera. Several images are several placements."""
    from closerange.apps.cli.screens import points_summary, points_text
    from closerange.features.points_table import write_points
    from closerange.workflows.shapes import find_shapes as work

    check_outputs([output], [*images, shapes])
    with Progress() as progress:
        points = work(
            images, shapes=shapes, camera=camera, placement=placement,
            placement_pattern=placement_pattern, progress=progress.step("finding"),
        )  # fmt: skip
    write_points(points, output)
    failure = None
    if not (points.flags == 0).any():
        failure = DataError(
            f"{output}: none of the shapes was found without a flag ({len(points)} rows)",
            remedy="check light and view, or teach the shape in this view with a larger --margin",
        )
    return Outcome(points_text(points, output), points_summary(points, output), failure=failure)
