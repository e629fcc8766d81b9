"""The words of a report, explained for a reader who was not there."""

from __future__ import annotations

from closerange.delivery.sheet import Section, Terms

_WORDS = {
    "accuracy": "How far the mean of the readings lies from the known position (trueness). The "
    "figure is the largest absolute error of all positions, axis by axis.",
    "repeatability": "How far readings of the same position scatter about their mean: their "
    "standard deviation (s), pooled over all positions.",
    "predicted error": "The standard deviation of one measured position that follows from the "
    "image noise and from the uncertainty of the calibration, without any comparison.",
    "95 % region": "The ellipsoid around a measured position that contains the true one in 95 of "
    "100 cases.",
    "residual": "Where a point was seen in the image minus where the calibration says it should "
    "be (RSS: sum of their squares).",
    "image noise": "The standard deviation of one image coordinate, from n coordinates that fix p "
    "parameters: s² = RSS / (n - p).",
    "placement": "One state of the world, for instance one position of the target.",
    "reading": "One of several measurements of the same placement.",
    "control point": "A point whose world position is known beforehand.",
    "check point": "A control point that was kept out of the calibration in order to test it.",
    "measuring volume": "The box in which the calibration holds; by default the box around all "
    "control points.",
    "guard band": "The distance from a limit within which a figure is neither accepted nor "
    "rejected, because it is not known well enough.",
}


def glossary_section(text: str) -> Section | None:
    """Explain the words that occur in a report.

    Parameters
    ----------
    text : str
        All words of the other sections.

    Returns
    -------
    Section or None
        None if none of the words occurs.
    """
    lower = text.lower()
    entries = tuple((word, meaning) for word, meaning in _WORDS.items() if word in lower)
    if not entries:
        return None
    return Section("glossary", "Glossary", (Terms(entries, anchor="word"),))


def words_in(text: str) -> list[str]:
    """Return the glossary's words that a text contains, as anchors name them."""
    lower = text.lower()
    return [word for word in _WORDS if word in lower]
