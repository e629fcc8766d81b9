"""What a report is made of: sections of paragraphs, tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from markupsafe import Markup

from closerange.delivery.overlays import Overlay
from closerange.features.image_points import ImagePoints
from closerange.position.positions import Positions
from closerange.rig.rig import Rig
from closerange.verification.error_map import ErrorMap


@dataclass(frozen=True, slots=True, eq=False)
class Contents:
    """Everything that a report may speak of; what is None or empty is left out.

    Attributes
    ----------
    title : str
        Name of the job.
    rig : Rig or None
        Calibrated cameras.
    points : ImagePoints or None
        Detected points.
    overlays : sequence of Overlay
        Pictures with the points drawn on them.
    positions : Positions or None
        Measured positions.
    checks : tuple of mapping
        Documents of verification results, each with its ``kind``.
    error_map : ErrorMap or None
        Predicted error in the volume.
    provenance : mapping
        Versions, options and input hashes: JSON-ready.
    notes : sequence of str
        Warnings and remarks.
    headline : str or None
        The verdict in one sentence; made from the data without it.
    """

    title: str
    rig: Rig | None = None
    points: ImagePoints | None = None
    overlays: Sequence[Overlay] = ()
    positions: Positions | None = None
    checks: tuple[Mapping[str, Any], ...] = ()
    error_map: ErrorMap | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    notes: Sequence[str] = ()
    headline: str | None = None

    def checks_of(self, kind: str) -> list[Mapping[str, Any]]:
        """Return the verification results of one kind."""
        return [check for check in self.checks if check.get("kind") == kind]


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A few sentences.

    Attributes
    ----------
    text : str
        Plain text.
    tone : str
        Empty, ``good``, ``warn`` or ``bad``: a mark at the margin, never the only message.
    """

    text: str
    tone: str = ""
    kind: str = "paragraph"


@dataclass(frozen=True, slots=True)
class Table:
    """A table with units in its head.

    Attributes
    ----------
    caption : str
        What it holds.
    head : tuple of str
        Column titles with units.
    rows : sequence of sequence of str
        Cells.
    texts : frozenset of int
        Columns that hold words: set to the left; numbers are set to the right.
    marked : frozenset of int
        Rows to be marked as defective; the row's words say why.
    wide : bool
        Small print, for tables of many columns.
    dense : bool
        Smallest print, for long lists that are looked up, not read.
    breakable : bool
        Cells of long texts without blanks, such as paths, may be broken anywhere.
    """

    caption: str
    head: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    texts: frozenset[int] = frozenset({0})
    marked: frozenset[int] = frozenset()
    wide: bool = False
    breakable: bool = False
    dense: bool = False
    kind: str = "table"

    @property
    def style(self) -> str:
        """Return the classes of the style sheet."""
        return " ".join(name for name in ("wide", "breakable", "dense") if getattr(self, name))


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture with its words.

    Attributes
    ----------
    picture : Markup
        Inline SVG.
    caption : str
        What one sees, with units and scale.
    half : bool
        Half as wide as the page: two stand side by side.
    """

    picture: Markup
    caption: str
    half: bool = False
    kind: str = "figure"


@dataclass(frozen=True, slots=True)
class Terms:
    """Words with their explanation.

    Attributes
    ----------
    entries : tuple of (str, str)
        Word and explanation.
    anchor : str
        If set, each word can be linked to as ``#<anchor>-<word>``.
    """

    entries: tuple[tuple[str, str], ...]
    anchor: str = ""
    kind: str = "terms"


Block: TypeAlias = Paragraph | Table | Figure | Terms


@dataclass(frozen=True, slots=True)
class Section:
    """A numbered part of the report.

    Attributes
    ----------
    anchor : str
        Name for links.
    title : str
        Heading.
    blocks : tuple of Block
        In order.
    """

    anchor: str
    title: str
    blocks: tuple[Block, ...]
