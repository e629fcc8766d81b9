"""Pieces of verification documents as table cells and sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from closerange.delivery.sheet import Block, Paragraph, Table
from closerange.delivery.wording import DASH, fixed, micrometres, percent
from closerange.geometry.arrays import FloatArray

MAX_ROWS = 200
"""Rows of a table that a report prints; the rest is in the CSV file."""

FOLD_ROWS = 40
"""Rows above which a table is looked up rather than read: folded on a screen."""

TOO_SMALL = "region too small"
"""Stated uncertainties that errors exceed by more than chance explains."""

DECISIONS = {"accept": "accepted", "reject": "rejected", "undecided": "undecided"}


def numbers(value: Any) -> FloatArray:
    """Read numbers of a document, in which null means "not known", as an array with NaN."""
    return np.array(value, dtype=np.float64)


def documents_of(checks: Sequence[object]) -> tuple[Mapping[str, Any], ...]:
    """Turn verification results into their documents; documents stay as they are.

    Parameters
    ----------
    checks : sequence of object
        Results with a `to_document` method, or mappings.

    Returns
    -------
    tuple of mapping
        In the same order.

    Raises
    ------
    TypeError
        If something is neither.
    """
    documents: list[Mapping[str, Any]] = []
    for check in checks:
        document = check if isinstance(check, Mapping) else None
        if document is None and hasattr(check, "to_document"):
            document = check.to_document()
        if not isinstance(document, Mapping):
            raise TypeError(f"{type(check).__name__} is not a verification result")
        documents.append(document)
    return tuple(documents)


def shown(
    rows: Sequence[Sequence[str]], caption: str, head: tuple[str, ...], **style: Any
) -> Table:
    """Make a table of at most `MAX_ROWS` rows that says so where it is cut; a long one folds.

    Columns of words that are blank in every row are left out.
    """
    cut = len(rows) - MAX_ROWS
    if cut > 0:
        caption = f"{caption} (first {MAX_ROWS} of {len(rows)} rows; for the others see the CSV)"
        style["marked"] = frozenset(row for row in style.get("marked", ()) if row < MAX_ROWS)
    folded = len(rows) > FOLD_ROWS
    texts = style.pop("texts", frozenset({0}))
    kept = [i for i in range(len(head)) if i not in texts or any(row[i] for row in rows)]
    return Table(
        caption,
        tuple(head[i] for i in kept),
        [tuple(row[i] for i in kept) for row in rows[:MAX_ROWS]],
        texts=frozenset(place for place, i in enumerate(kept) if i in texts),
        folded=folded,
        **style,
    )


def coverage_word(coverage: Mapping[str, Any]) -> str:
    """Judge whether stated uncertainties hold.

    Parameters
    ----------
    coverage : mapping
        Document of a `Coverage`.

    Returns
    -------
    str
        ``holds``, ``region too small``, ``cautious`` or a dash where nothing is known.
    """
    level = float(coverage["level"])
    share, low, high, ratio = (
        float(numbers(coverage[name])) for name in ("share", "low", "high", "mean_ratio")
    )
    if not np.isfinite(share):
        return DASH
    # The interval takes errors as independent, but they share one calibration, whose luck alone
    # moves the ratio: with ten effective parameters it stays below 2 in 97 of 100 calibrations.
    if high < level and ratio > 2:
        return TOO_SMALL
    return "cautious" if low > level else "holds"


def coverage_text(coverage: Mapping[str, Any]) -> str:
    """Say how many errors lie inside their stated regions."""
    share, low, high, ratio = (
        float(numbers(coverage[name])) for name in ("share", "low", "high", "mean_ratio")
    )
    if not np.isfinite(share):
        return "No covariances were stated, hence there is nothing to compare."
    level = f"{100 * coverage['level']:.0f} %"
    return (
        f"{coverage['inside']} of {coverage['count']} errors ({percent(share)}) lie inside their "
        f"stated {level} region; with independent errors the true share is between {percent(low)} "
        f"and {percent(high)}. Mean squared error / predicted variance: {fixed(ratio, 2)} (1 if "
        "the covariances hold)."
    )


def proving_group(check: Mapping[str, Any]) -> tuple[str, str]:
    """Prefer points that were not used for the calibration: only they prove anything."""
    group = check["groups"].get("check")
    if group is not None and group["count"]:
        return "check", "check point"
    return "all", "control point"


def left_out(check: Mapping[str, Any]) -> list[Block]:
    """List what was not used, with the reason."""
    blocks: list[Block] = []
    if check.get("left_out"):
        cells = [
            (placement, reading, point, flags.replace("|", ", "))
            for placement, reading, point, flags in check["left_out"]
        ]
        head = ("placement", "reading", "point", "why (see Flags)")
        blocks.append(shown(cells, "Not used", head, texts=frozenset(range(4))))
    if check.get("missing"):
        names = listed(" ".join(filter(None, item)) for item in check["missing"])
        blocks.append(Paragraph(f"Without a counterpart: {names}.", "warn"))
    return blocks


def listed(names: Iterable[str], most: int = 20) -> str:
    """Join names; beyond `most` only their count."""
    found = list(names)
    rest = f" and {len(found) - most} more" if len(found) > most else ""
    return ", ".join(found[:most]) + rest


def four(values_mm: Any) -> list[str]:
    """Write X, Y, Z and, where it is there, the figure in space in um."""
    texts = [micrometres(float(value)) for value in numbers(values_mm)]
    return texts + [DASH] * (4 - len(texts))
