"""The verb `verify`: positions are compared with a known truth."""

from __future__ import annotations

import warnings
from pathlib import Path

from closerange.errors import CloseRangeWarning, InputError
from closerange.features.control import ControlPoints, read_control
from closerange.position.positions import Positions
from closerange.position.positions_table import read_positions
from closerange.rig.rig import Rig
from closerange.rig.rig_file import read_rig
from closerange.verification.acceptance import AcceptanceReport
from closerange.verification.control_check import ControlCheck, compare_with_control
from closerange.verification.heights import HeightCheck, height_test
from closerange.verification.judgement import Limits
from closerange.verification.known_parts import Parts, read_parts
from closerange.verification.lengths import LengthCheck, Lengths, length_test, read_lengths
from closerange.verification.single_point import single_point_test
from closerange.verification.travel import truth_hints

KINDS = ("control", "single-point", "lengths", "heights")

Result = ControlCheck | AcceptanceReport | LengthCheck | HeightCheck
Truth = ControlPoints | Lengths | Parts


def verify(
    kind: str,
    positions: Positions | Path | str,
    *,
    truth: Truth | Path | str,
    rig: Rig | Path | str | None = None,
    limits: Limits | None = None,
    cycle_time_s: float | None = None,
    cycle_time_includes: str = "",
) -> Result:
    """Compare measured positions with a known truth.

    Parameters
    ----------
    kind : str
        ``control`` (tables and averages for control points), ``single-point`` (accuracy and
        repeatability by repeated readings, chapter 3), ``lengths`` (known distances) or
        ``heights`` (parts whose tops are known).
    positions : Positions or path
        What was measured, or its table.
    truth : ControlPoints, Lengths, Parts or path
        True positions (control table), true lengths (``point_a, point_b, length_mm``) or parts
        (``part, shape, x_mm, y_mm, z_mm, size_x_mm, size_y_mm, rotation_deg, height_mm``).
    rig : Rig or path, optional
        With it, `control` tells fitted from check points and inside from outside the volume.
    limits : Limits, optional
        Permissible errors; with them `single-point` decides.
    cycle_time_s : float, optional
        Time from the command to the result, for `single-point`.
    cycle_time_includes : str, optional
        What was timed, if it is less than that.

    Returns
    -------
    ControlCheck, AcceptanceReport, LengthCheck or HeightCheck
        What was found; each has `to_document`.

    Raises
    ------
    InputError
        If a file, the kind or the truth cannot be used.
    DataError
        If no measured position has a truth.

    Warns
    -----
    CloseRangeWarning
        Of differences so regular that a scale, a lost turn or one placement explains them.
    """
    if kind not in KINDS:
        raise InputError(
            f"kind {kind!r} of verification", remedy=f"known kinds are {', '.join(KINDS)}"
        )
    if not isinstance(positions, Positions):
        positions = read_positions(positions)
    if kind == "lengths":
        return length_test(positions, _lengths(truth))
    if kind == "heights":
        return height_test(positions, _parts(truth))
    control = _control(truth)
    for hint in truth_hints(positions, control):
        warnings.warn(hint, CloseRangeWarning, stacklevel=2)
    if kind == "single-point":
        return single_point_test(
            positions,
            control,
            limits=limits,
            cycle_time_s=cycle_time_s,
            cycle_time_includes=cycle_time_includes,
        )
    return _control_check(positions, control, rig)


def _control_check(
    positions: Positions, control: ControlPoints, rig: Rig | Path | str | None
) -> ControlCheck:
    if rig is None:
        return compare_with_control(positions, control)
    if not isinstance(rig, Rig):
        rig = read_rig(rig)
    rows = rig.residuals
    fitted = {(rows.placement[i], rows.point[i]) for i in range(len(rows)) if bool(rows.fitted[i])}
    return compare_with_control(positions, control, fitted=fitted, volume_mm=rig.volume_mm)


def _control(truth: Truth | Path | str) -> ControlPoints:
    if isinstance(truth, Lengths | Parts):
        what = "true lengths" if isinstance(truth, Lengths) else "parts"
        raise InputError(f"{what} given", remedy="this kind compares with true positions")
    return truth if isinstance(truth, ControlPoints) else read_control(truth)


def _lengths(truth: Truth | Path | str) -> Lengths:
    if isinstance(truth, ControlPoints | Parts):
        what = "true positions" if isinstance(truth, ControlPoints) else "parts"
        raise InputError(f"{what} given", remedy="the kind lengths compares with lengths")
    return truth if isinstance(truth, Lengths) else read_lengths(truth)


def _parts(truth: Truth | Path | str) -> Parts:
    if isinstance(truth, ControlPoints | Lengths):
        what = "true positions" if isinstance(truth, ControlPoints) else "true lengths"
        raise InputError(f"{what} given", remedy="the kind heights compares with parts")
    return truth if isinstance(truth, Parts) else read_parts(truth)
