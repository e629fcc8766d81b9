"""The verb `volume`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from closerange.apps.cli import options
from closerange.apps.cli.console import Outcome, verb
from closerange.apps.cli.outputs import check_outputs
from closerange.apps.cli.progress import Progress

if TYPE_CHECKING:
    from closerange.matching.proposed_volume import VolumeProposal


@verb
def volume(
    rig: options.RigFile,
    least: Annotated[
        int | None,
        typer.Option(
            metavar="N", help="How many cameras must see a place; by default as many as can."
        ),
    ] = None,
    margin: Annotated[
        float, typer.Option(metavar="PX", help="How far from the borders of the images.")
    ] = 0.0,
    z: Annotated[
        tuple[float, float] | None,
        typer.Option(
            metavar="MIN MAX", help="Propose between these heights only, mm; as above a table."
        ),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="FILE.svg", help="Also draw the views and volumes, SVG or PNG."),
    ] = None,
    _json: options.Json = False,
) -> Outcome:
    """Find what the cameras see in common, and propose a measuring volume in it."""
    from closerange.workflows.volume import check_drawing, draw_volume
    from closerange.workflows.volume import volume as work

    check_outputs([plot], [rig])
    check_drawing(plot)
    with Progress("looking"):
        proposal = work(rig, least=least, margin_px=margin, z_mm=z)
        if plot is not None:
            draw_volume(proposal, plot)
    return Outcome(_text(proposal, plot), _summary(proposal, plot))


def _text(proposal: VolumeProposal, plot: Path | None) -> str:
    from closerange.apps.cli.screens import box_text, lines, micrometres

    view = proposal.view
    shares = ", ".join(
        f"{100 * share:.0f} % of {camera.name}"
        for camera, share in zip(proposal.cameras, proposal.shared, strict=True)
    )
    low, high = view.depth_range_mm
    errors = "  ".join(
        f"{micrometres(best)} to {micrometres(worst)} ({axis})"
        for axis, best, worst in zip("XYZ", *proposal.std_mm, strict=True)
    )
    corners = " ".join(f"{value:g}" for value in proposal.volume_mm.ravel())
    seen = f"{100 * proposal.calibrated_seen:.0f} % of it in common view"
    return lines(
        ("Common view", f"{shares}; {view.least} cameras must see a place"),
        ("Depth", f"{'XYZ'[view.depth_axis]} {low:.0f} to {high:.0f} mm"),
        ("Proposed", box_text(proposal.volume_mm)),
        ("Error there", f"{errors} for {view.noise_px:.3f} px in the images"),
        ("Calibrated", f"{box_text(proposal.calibrated_mm)}, {seen}"),
        ("To use it", f"closerange calibrate ... --volume {corners}"),
        ("Drawing", plot or ""),
    )


def _summary(proposal: VolumeProposal, plot: Path | None) -> dict[str, Any]:
    view = proposal.view
    names = [camera.name for camera in proposal.cameras]
    return {
        "cameras": names,
        "least": view.least,
        "volume_mm": proposal.volume_mm.tolist(),
        "std_mm": proposal.std_mm.tolist(),
        "noise_px": view.noise_px,
        "calibrated_mm": proposal.calibrated_mm.tolist(),
        "calibrated_seen": proposal.calibrated_seen,
        "depth_axis": "XYZ"[view.depth_axis],
        "depth_range_mm": list(view.depth_range_mm),
        "shared": dict(zip(names, proposal.shared.tolist(), strict=True)),
        "plot": None if plot is None else str(plot),
    }
