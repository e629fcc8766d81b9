"""When images were taken: a set is one moment only as far as its cameras exposed together.

Times come from whoever triggered the cameras, as a table. The times that files carry are not
used: a file's own is that of its writing, PNG states only the last change, and EXIF the clock of
one camera, in whole seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from closerange.errors import InputError, TableError
from closerange.files import read_csv, text_cell

Key = tuple[str, str, str]
"""Camera, placement and reading."""


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """Moments of exposure.

    Attributes
    ----------
    source : str
        Where they come from, for messages.
    time_s : mapping of (str, str, str) to float
        Seconds on one clock, by (camera, placement, reading).
    """

    source: str
    time_s: Mapping[Key, float]


def read_exposures(path: Path | str) -> Exposures:
    """Read a table of exposure times.

    Parameters
    ----------
    path : Path or str
        CSV file with ``camera, placement, time_s`` and optionally ``reading``; one clock for all
        cameras, from any origin.

    Returns
    -------
    Exposures
        Its rows.

    Raises
    ------
    FileError
        If the file cannot be read.
    TableError
        If a row breaks the contract, or an image has two times.
    """
    table = read_csv(path, required=("camera", "placement", "time_s"), optional=("reading",))
    cameras = [text_cell(t, table.where(i, "camera")) for i, t in enumerate(table.texts("camera"))]
    times = table.floats("time_s")
    keys = zip(cameras, table.texts("placement"), table.texts("reading"), strict=True)
    found: dict[Key, float] = {}
    for row, key in enumerate(keys):
        if key in found:
            raise TableError(
                f"{table.where(row, 'camera')}: {_key_text(key)} has two times",
                remedy="remove one of the two rows; a column reading tells repetitions apart",
            )
        found[key] = times[row]
    return Exposures(str(path), found)


def check_exposures(images: Iterable[Key], exposures: Exposures, *, tolerance_s: float) -> None:
    """Refuse sets of images whose cameras did not expose together.

    Parameters
    ----------
    images : iterable of (str, str, str)
        Camera, placement and reading of every image that is used.
    exposures : Exposures
        When each was taken; times of other images do no harm.
    tolerance_s : float
        Largest allowed difference between the first and the last exposure of a set, in seconds.
        An object at v mm/s moves v * tolerance_s mm meanwhile: choose it so that this stays below
        the accuracy that is asked for.

    Raises
    ------
    InputError
        If the tolerance is no duration, an image has no time, or cameras exposed further apart:
        the message names the worst set, and how many exceed the limit.
    """
    if not (math.isfinite(tolerance_s) and tolerance_s >= 0):
        raise InputError(
            f"a time tolerance of {tolerance_s} s", remedy="give a number of seconds, 0 or more"
        )
    sets: dict[tuple[str, str], dict[str, float]] = {}
    for key in dict.fromkeys(images):
        if key not in exposures.time_s:
            raise InputError(
                f"{exposures.source}: no time for {_key_text(key)}",
                remedy="add the row, named as in the points table or by the placement pattern",
            )
        sets.setdefault(key[1:], {})[key[0]] = exposures.time_s[key]
    late = {key: times for key, times in sets.items() if _gap_s(times) > tolerance_s}
    if not late:
        return
    placement, reading = max(late, key=lambda key: _gap_s(late[key]))
    times = late[placement, reading]
    first, last = min(times, key=lambda name: times[name]), max(times, key=lambda name: times[name])
    raise InputError(
        f"{exposures.source}: cameras {first!r} and {last!r} took "
        f"{_set_text(placement, reading)} {_gap_s(times):.6g} s apart, the limit is "
        f"{tolerance_s:.6g} s; {len(late)} of {len(sets)} sets exceed it",
        remedy=_same_offset(sets, tolerance_s)
        or "trigger the cameras together, or leave these sets out",
    )


def _gap_s(times: Mapping[str, float]) -> float:
    """Return the time between the first and the last exposure of a set."""
    return max(times.values()) - min(times.values())


def _same_offset(sets: Mapping[tuple[str, str], Mapping[str, float]], tolerance_s: float) -> str:
    """Say so if two cameras differ by the same time in every set: then only their clocks do."""
    cameras = list(dict.fromkeys(name for times in sets.values() for name in times))
    together = [times for times in sets.values() if len(times) == 2]
    if len(cameras) != 2 or len(together) < 3:  # two sets could agree by chance
        return ""
    offsets = [times[cameras[1]] - times[cameras[0]] for times in together]
    if max(offsets) - min(offsets) > tolerance_s:
        return ""
    middle = (max(offsets) + min(offsets)) / 2
    return (
        f"camera {cameras[1]!r} differs by the same {middle:.6g} s in every set: if its clock is "
        "off by that much, subtract it from the camera's times"
    )


def _set_text(placement: str, reading: str) -> str:
    return f"placement {placement!r}" + (f", reading {reading!r}" if reading else "")


def _key_text(key: Key) -> str:
    return f"camera {key[0]!r}, {_set_text(*key[1:])}"
