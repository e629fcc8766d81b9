"""The section on what the cameras see in common, and on the measuring volume that it proposes."""

from __future__ import annotations

from closerange.delivery.common_view_plot import draw_common_view
from closerange.delivery.sheet import Contents, Figure, Paragraph, Section, Table
from closerange.delivery.wording import (
    fixed,
    micrometres,
    percent,
    significant,
)
from closerange.matching.proposed_volume import VolumeProposal
from closerange.matching.volume_proposal import EVEN


def common_view_section(contents: Contents) -> Section | None:
    """Show the common field of view and a measuring volume in it (Figs. 5.1 and 5.2).

    Parameters
    ----------
    contents : Contents
        Only its proposal is used.

    Returns
    -------
    Section or None
        None without a proposal.
    """
    proposal = contents.proposal
    if proposal is None:
        return None
    picture = draw_common_view(
        proposal.cameras,
        proposal.view,
        proposal.volume_mm,
        calibrated_mm=proposal.calibrated_mm,
    )
    caption = (
        "Above: the cameras as they stand, and with their axes turned parallel, which leaves less "
        "of their images in common. Below: sections of what they see in common, along both "
        "directions across the view. Nothing hides anything here: what will stand in the volume "
        "is not known."
    )
    blocks = (
        Paragraph(_view_sentence(proposal)),
        _volumes_table(proposal),
        Paragraph(_advice()),
        Figure(picture.render(), caption),
    )
    return Section("common-view", "Common field of view", blocks)


def _view_sentence(proposal: VolumeProposal) -> str:
    view, count = proposal.view, len(proposal.cameras)
    shares = ", ".join(
        f"{percent(float(share))} ({camera.name})"
        for camera, share in zip(proposal.cameras, proposal.shared, strict=True)
    )
    who = "the other camera" if count == 2 else "all others"
    if view.least < count:  # not all of them share a place
        who = f"{view.least - 1} or more others"
    low, high = (significant(value) for value in view.depth_range_mm)
    return (
        f"Of the images, {shares} is seen by {who} too, at the depth of the proposed volume's "
        f"middle. The common view reaches from {'XYZ'[view.depth_axis]} = {low} to {high} mm; it "
        "ends where rays cross at less than 1 degree. Of the calibrated measuring volume, "
        f"{percent(proposal.calibrated_seen)} lies in it."
    )


def _volumes_table(proposal: VolumeProposal) -> Table:
    rows = []
    for axis, name in enumerate("XYZ"):
        used, proposed = proposal.calibrated_mm[:, axis], proposal.volume_mm[:, axis]
        std = proposal.std_mm[:, axis]
        limits = [*used, used[1] - used[0], *proposed, proposed[1] - proposed[0]]
        cells = [fixed(float(value), 1) for value in limits]
        rows.append((name, *cells, *(micrometres(float(value)) for value in std)))
    head = (
        "axis",
        *("calibrated from [mm]", "to [mm]", "size [mm]"),
        *("proposed from [mm]", "to [mm]", "size [mm]"),
        *("smallest error there [µm]", "largest [µm]"),
    )
    return Table("Measuring volume: calibrated and proposed", head, rows)


def _advice() -> str:
    return (
        "The proposal is the box in which the cameras can tell most positions apart while the "
        f"error in space at its worst place is at most {fixed(EVEN, 0)} times that at the best; "
        "the errors in the table are one standard deviation from the image noise alone. It follows "
        "from where the cameras stand, not from where the control points were: outside of the "
        "calibrated volume the calibration has not been seen to hold. To use the proposal, spread "
        "control points over it and give it to 'closerange calibrate --volume'."
    )
