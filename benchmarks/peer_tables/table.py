"""What the comparisons share: repeated measurements, ratios, one table and its bars."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thesis.tables import Lines, fixed, markdown

FloatArray = NDArray[np.float64]

BAR = 1.05
"""Our error over that of the best peer, at most."""

OURS, VARIANT, PEER = "ours", "variant", "peer"


@dataclass(frozen=True, slots=True)
class Quantity:
    """One kind of error: its heading, how it is written and whether the bar applies to it."""

    name: str
    unit: str
    scale: float = 1.0
    decimals: int = 1
    judged: bool = True


@dataclass(slots=True, eq=False)
class Measured:
    """One method's errors and times, one entry a repeat; NaN where it failed.

    `kind` is `OURS` for what the bar applies to, `PEER` for what it is compared with and `VARIANT`
    for options of this program that are shown for information. The first `OURS` is the reference
    of all ratios.
    """

    method: str
    kind: str
    errors: list[tuple[float, ...]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    failed: int = 0
    reason: str = ""

    def error(self, column: int) -> FloatArray:
        """Return one quantity for all repeats."""
        return np.array([row[column] for row in self.errors])


@dataclass(frozen=True, slots=True)
class Bar:
    """Whether one quantity of one of our methods is within the bar."""

    where: str
    ratio: float
    peer: str

    @property
    def held(self) -> bool:
        """False if the best peer is better by more than the bar allows."""
        return self.ratio <= BAR

    def __str__(self) -> str:
        verdict = "holds" if self.held else "MISSED"
        return f"{self.where}: {self.ratio:.3f} x the best peer ({self.peer}), {verdict}"


def run(measured: Measured, work: Callable[[], tuple[float, ...]], quantities: int) -> None:
    """Do one repeat; `work` returns seconds and errors. A failure is counted and not hidden."""
    try:
        seconds, *errors = work()
    except Exception as error:  # noqa: BLE001  # whatever a peer raises
        measured.failed += 1
        measured.reason = str(error).partition("\n")[0]
        seconds, errors = np.nan, [np.nan] * quantities
    measured.errors.append(tuple(errors))
    measured.seconds.append(seconds)


def rotated(methods: Sequence[Measured], repeat: int) -> list[Measured]:
    """Begin with another method in each repeat, so that none always meets a cold cache."""
    start = repeat % len(methods)
    return [*methods[start:], *methods[:start]]


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return seconds and result."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def lines(
    title: str, methods: Sequence[Measured], quantities: Sequence[Quantity], clock: str
) -> Lines:
    """Write one table: medians over repeats, medians of paired ratios, spread of the times."""
    header = ["method"]
    for quantity in quantities:
        header += [f"{quantity.name}, {quantity.unit}", "ratio"]
    header += [f"{clock}, ms", "10-90 %, ms", "ratio", "failed"]
    reference = next(m for m in methods if m.kind == OURS)
    rows = [_row(method, reference, quantities) for method in methods]
    failures = [f"{m.method} failed {m.failed} times: {m.reason}" for m in methods if m.failed]
    return [f"## {title}", *markdown(header, rows), *failures]


def bars(where: str, methods: Sequence[Measured], quantities: Sequence[Quantity]) -> list[Bar]:
    """Compare our methods with the best peer in each judged quantity."""
    found = []
    peers = [m for m in methods if m.kind == PEER]
    for ours in (m for m in methods if m.kind == OURS):
        for column, quantity in enumerate(quantities):
            ratios = {peer.method: 1 / _ratio(peer, ours, column) for peer in peers}
            known = {name: ratio for name, ratio in ratios.items() if np.isfinite(ratio)}
            if quantity.judged and known:
                best = max(known, key=lambda name: known[name])
                name = f"{where}, {ours.method}, {quantity.name}"
                found.append(Bar(name, known[best], best))
    return found


def _row(method: Measured, reference: Measured, quantities: Sequence[Quantity]) -> list[str]:
    cells = [method.method]
    for column, quantity in enumerate(quantities):
        value = _median(method.error(column)) * quantity.scale
        cells += [fixed(value, quantity.decimals), fixed(_ratio(method, reference, column), 3)]
    spent = 1000 * np.array(method.seconds)
    spent = spent[np.isfinite(spent)]
    if not len(spent):
        return [*cells, "n/a", "n/a", "n/a", str(method.failed)]
    low, high = np.percentile(spent, [10, 90])
    slower = np.array(method.seconds) / np.array(reference.seconds)
    cells += [fixed(_median(spent), 2), f"{low:.2f}-{high:.2f}", fixed(_median(slower), 2)]
    return [*cells, str(method.failed)]


def _ratio(method: Measured, reference: Measured, column: int) -> float:
    """Return the median over repeats of this method's error over the reference's."""
    return _median(method.error(column) / reference.error(column))


def _median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else float("nan")
