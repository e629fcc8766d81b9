"""The report: one HTML file that a customer can be handed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from closerange.delivery.answers import answers
from closerange.delivery.calibration_section import calibration_section
from closerange.delivery.check_sections import check_sections
from closerange.delivery.common_view_section import common_view_section
from closerange.delivery.excerpts import documents_of
from closerange.delivery.facts import provenance_section
from closerange.delivery.figures_table import figures_table
from closerange.delivery.front_page import front_picture, verdict
from closerange.delivery.glossary import glossary_section, words_in
from closerange.delivery.match_pictures import ScenePictures
from closerange.delivery.match_section import match_sections
from closerange.delivery.overlays import Overlay
from closerange.delivery.report_sections import (
    flags_section,
    measured_section,
    pictures_section,
    prediction_section,
)
from closerange.delivery.sheet import Contents, Files, Paragraph, Section, Table, Terms
from closerange.delivery.table_sections import points_section, positions_section
from closerange.delivery.wording import printed
from closerange.features.image_points import ImagePoints
from closerange.matching.correspondences import Correspondences
from closerange.matching.proposed_volume import VolumeProposal
from closerange.position.positions import Positions
from closerange.rig.rig import Rig
from closerange.verification.error_map import ErrorMap
from closerange.version import __version__


def render_report(  # noqa: PLR0913 - each argument is one thing that a report may hold
    *,
    title: str,
    rig: Rig | None = None,
    points: ImagePoints | Mapping[str, ImagePoints] | None = None,
    overlays: Sequence[Overlay] = (),
    positions: Positions | Mapping[str, Positions] | None = None,
    matches: Correspondences | Mapping[str, Correspondences] | None = None,
    scenes: ScenePictures | Mapping[str, ScenePictures] | None = None,
    checks: Sequence[object] = (),
    error_map: ErrorMap | None = None,
    proposal: VolumeProposal | None = None,
    provenance: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    headline: str | None = None,
) -> str:
    """Render a report as one self-contained HTML file.

    Parameters
    ----------
    title : str
        Name of the job.
    rig : Rig, optional
        Calibrated cameras.
    points : ImagePoints or mapping of str to ImagePoints, optional
        Detected points; those of several jobs by the name of the job.
    overlays : sequence of Overlay, optional
        Pictures with what was found on them; about 100 kB each.
    positions : Positions or mapping of str to Positions, optional
        Measured positions, likewise.
    matches : Correspondences or mapping of str to Correspondences, optional
        Matched points, likewise; their positions have the same names.
    scenes : ScenePictures or mapping of str to ScenePictures, optional
        Pictures of the matched scenes, likewise.
    checks : sequence of object, optional
        Verification results (`ControlCheck`, `AcceptanceReport`, `LengthCheck`, `HeightCheck`) or
        their stored documents.
    error_map : ErrorMap, optional
        Predicted error in the volume.
    proposal : VolumeProposal, optional
        What the cameras see in common, and a measuring volume in it.
    provenance : mapping, optional
        Versions, options, input hashes: JSON-ready.
    notes : sequence of str, optional
        Warnings.
    headline : str, optional
        The verdict in one sentence; made from the data without it.

    Returns
    -------
    str
        HTML that needs no other file, no script and no network; the same for the same input.
        Sections without data are left out.
    """
    contents = Contents(
        title=title,
        rig=rig,
        points={"": points} if isinstance(points, ImagePoints) else points or {},
        overlays=tuple(overlays),
        positions={"": positions} if isinstance(positions, Positions) else positions or {},
        matches={"": matches} if isinstance(matches, Correspondences) else matches or {},
        scenes={"": scenes} if isinstance(scenes, ScenePictures) else scenes or {},
        checks=documents_of(checks),
        error_map=error_map,
        proposal=proposal,
        provenance=provenance or {},
        notes=tuple(notes),
        headline=headline,
    )
    return _render(contents)


def _render(contents: Contents) -> str:
    front_table = figures_table(contents)
    sections = _sections(contents)
    spoken = " ".join(_spoken(sections, front_table))
    glossary = glossary_section(spoken)
    if glossary is not None:
        sections.append(glossary)
    known = {word for word, _ in _entries(glossary)}
    environment = Environment(
        loader=PackageLoader("closerange.delivery", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["linked"] = lambda text: _linked(text, known)
    return environment.get_template("report.html.j2").render(
        contents=contents,
        verdict=verdict(contents),
        answers=answers(contents),
        picture=front_picture(contents),
        figures=front_table,
        sections=sections,
        version=__version__,
    )


def _sections(contents: Contents) -> list[Section]:
    """Put the sections together, leaving out those without data."""
    found = [
        _notes_section(contents),
        measured_section(contents),
        *check_sections(contents.checks),
        *match_sections(contents),
        prediction_section(contents),
        common_view_section(contents),
        calibration_section(contents),
        positions_section(contents),
        points_section(contents),
        pictures_section(contents),
        flags_section(contents),
        provenance_section(contents.provenance),
    ]
    return [section for section in found if section is not None]


def _notes_section(contents: Contents) -> Section | None:
    """List every warning once."""
    texts = [*contents.notes]
    for check in contents.checks:
        texts += check.get("warnings") or ()
    unique = dict.fromkeys(printed(str(text)) for text in texts)
    blocks = tuple(Paragraph(text, "warn") for text in unique)
    return Section("warnings", "Warnings", blocks) if blocks else None


def _spoken(sections: Sequence[Section], table: Table | None) -> list[str]:
    """Collect the words of a report, to explain those and only those."""
    texts: list[str] = []
    for block in (*([table] if table else []), *(b for part in sections for b in part.blocks)):
        if isinstance(block, Table):
            texts += [block.caption, *block.head, *(row[0] for row in block.rows if row)]
        elif isinstance(block, Terms):
            texts += [f"{word} {meaning}" for word, meaning in block.entries]
        elif isinstance(block, Files):
            texts.append(block.caption)
        else:
            texts.append(block.text if isinstance(block, Paragraph) else block.caption)
    return texts


def _entries(section: Section | None) -> list[tuple[str, str]]:
    blocks = section.blocks if section is not None else ()
    return [entry for block in blocks if isinstance(block, Terms) for entry in block.entries]


def _linked(text: str, known: set[str]) -> Markup:
    """Link the first word of the glossary in a text to its explanation."""
    for word in words_in(text):
        if word in known:
            start = text.lower().index(word)
            end = start + len(word)
            anchor = word.replace(" ", "-").replace("%", "percent")
            link = Markup('<a href="#word-{}">{}</a>').format(anchor, text[start:end])
            return escape(text[:start]) + link + escape(text[end:])
    return escape(text)
