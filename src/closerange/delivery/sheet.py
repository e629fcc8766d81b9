"""What a report is made of: sections of paragraphs, tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from markupsafe import Markup

from closerange.delivery.match_pictures import ScenePictures
from closerange.delivery.overlays import Overlay
from closerange.features.image_points import ImagePoints
from closerange.matching.correspondences import Correspondences
from closerange.matching.proposed_volume import VolumeProposal
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
    points : mapping of str to ImagePoints
        Detected points by the name of their job; a name may be empty.
    overlays : sequence of Overlay
        Pictures with the points drawn on them.
    positions : mapping of str to Positions
        Measured positions by the name of their job.
    matches : mapping of str to Correspondences
        Matched points by the name of their job.
    scenes : mapping of str to ScenePictures
        Pictures of matched scenes by the name of their job.
    checks : tuple of mapping
        Documents of verification results, each with its ``kind``.
    error_map : ErrorMap or None
        Predicted error in the volume.
    proposal : VolumeProposal or None
        What the cameras see in common.
    provenance : mapping
        Versions, options and input hashes: JSON-ready.
    notes : sequence of str
        Warnings and remarks.
    headline : str or None
        The verdict in one sentence; made from the data without it.
    """

    title: str
    rig: Rig | None = None
    points: Mapping[str, ImagePoints] = field(default_factory=dict)
    overlays: Sequence[Overlay] = ()
    positions: Mapping[str, Positions] = field(default_factory=dict)
    matches: Mapping[str, Correspondences] = field(default_factory=dict)
    scenes: Mapping[str, ScenePictures] = field(default_factory=dict)
    checks: tuple[Mapping[str, Any], ...] = ()
    error_map: ErrorMap | None = None
    proposal: VolumeProposal | None = None
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
    breakable : bool
        Cells of long texts without blanks, such as paths, may be broken anywhere.
    folded : bool
        Shown on a screen only when asked for.
    printed : bool
        Whether paper shows it too; a long table that repeats a file beside the report need not.
    """

    caption: str
    head: tuple[str, ...]
    rows: Sequence[Sequence[str]]
    texts: frozenset[int] = frozenset({0})
    marked: frozenset[int] = frozenset()
    wide: bool = False
    breakable: bool = False
    folded: bool = False
    printed: bool = True
    kind: str = "table"

    @property
    def style(self) -> str:
        """Return the classes of the style sheet."""
        return " ".join(name for name in ("wide", "breakable") if getattr(self, name))

    @property
    def summary(self) -> str:
        """Return what stands for the table while it is folded."""
        rows = "" if "rows" in self.caption else f": {len(self.rows)} rows"
        return f"{self.caption}{rows}{'' if self.printed else '; not printed'}"


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture with its words.

    Attributes
    ----------
    picture : Markup
        Inline SVG.
    caption : str
        What one sees, with units and scale.
    half, quarter : bool
        Half or a quarter as wide as the page: two or four stand side by side.
    """

    picture: Markup
    caption: str
    half: bool = False
    quarter: bool = False
    kind: str = "figure"


@dataclass(frozen=True, slots=True)
class Files:
    """A long list of files with their SHA-256: folded on a screen, in small print on paper.

    Attributes
    ----------
    caption : str
        What they are, how many, and one hash for all of them.
    entries : tuple of (str, str)
        Name and digest.
    """

    caption: str
    entries: tuple[tuple[str, str], ...]
    kind: str = "files"


@dataclass(frozen=True, slots=True)
class Terms:
    """Words with their explanation.

    Attributes
    ----------
    entries : tuple of (str, str)
        Word and explanation.
    anchor : str
        If set, each word can be linked to as ``#<anchor>-<word>``.
    style : str
        A class of the style sheet.
    """

    entries: tuple[tuple[str, str], ...]
    anchor: str = ""
    style: str = ""
    kind: str = "terms"


Block: TypeAlias = Paragraph | Table | Figure | Files | Terms


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
