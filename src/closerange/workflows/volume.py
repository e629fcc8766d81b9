"""The verb `volume`: what the cameras see in common, and a measuring volume to propose."""

from __future__ import annotations

from pathlib import Path

from closerange.delivery.canvas import encode_png
from closerange.delivery.common_view_plot import draw_common_view
from closerange.errors import GeometryError, InputError
from closerange.files import write_bytes, write_text
from closerange.matching.proposed_volume import VolumeProposal, survey_volume
from closerange.matching.sight import between_planes
from closerange.rig.rig import Rig
from closerange.rig.rig_file import read_rig

KINDS = (".svg", ".png")
"""Endings of a drawing's name."""

__all__ = ["check_drawing", "draw_volume", "proposal_of", "volume"]


def volume(
    rig: Rig | Path | str,
    *,
    least: int | None = None,
    margin_px: float = 0.0,
    z_mm: tuple[float, float] | None = None,
) -> VolumeProposal:
    """Find what the cameras see in common, and propose a measuring volume in it.

    Parameters
    ----------
    rig : Rig or path
        Calibrated cameras, or their file.
    least : int, optional
        How many cameras must see a place. By default all; as many as share any place where not
        all do.
    margin_px : float, optional
        How far from the borders of the images a place must be seen.
    z_mm : (float, float), optional
        Propose between these heights only, such as above a table.

    Returns
    -------
    VolumeProposal
        The proposal with its errors, the common view, and the rig's own volume beside it. The
        proposal can be given to `closerange.calibrate` and `closerange.match` as `volume_mm`.

    Raises
    ------
    InputError
        If the file or an option cannot be used, or there is a single camera.
    GeometryError
        If no two cameras see the same place.
    """
    rig = rig if isinstance(rig, Rig) else read_rig(rig)
    within = None if z_mm is None else between_planes(*z_mm)
    return survey_volume(rig, least=least, margin_px=margin_px, within_mm=within)


def proposal_of(rig: Rig) -> VolumeProposal | None:
    """Propose a volume for a report; None where no two cameras see the same place."""
    if len(rig.cameras) < 2:
        return None
    try:
        return survey_volume(rig)
    except GeometryError:
        return None


def check_drawing(path: Path | None) -> None:
    """Refuse a drawing whose name has another ending than those that can be written."""
    if path is not None and path.suffix.lower() not in KINDS:
        raise InputError(
            f"{path}: a drawing is written as {' or '.join(KINDS)}",
            remedy=f"name it {path.stem or 'volume'}{KINDS[0]}",
        )


def draw_volume(proposal: VolumeProposal, path: Path) -> None:
    """Write the drawing of a proposal.

    Parameters
    ----------
    proposal : VolumeProposal
        What `volume` found.
    path : Path
        File to write, SVG or PNG by its ending.

    Raises
    ------
    InputError, FileError
        If the ending is another one, or the file cannot be written.
    """
    check_drawing(path)
    drawing = draw_common_view(
        proposal.cameras,
        proposal.view,
        proposal.volume_mm,
        calibrated_mm=proposal.calibrated_mm,
    )
    if path.suffix.lower() == ".png":
        write_bytes(path, encode_png(drawing.paint()))
        return
    head = '<svg xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" '
    write_text(path, str(drawing.render()).replace("<svg ", head, 1) + "\n")
