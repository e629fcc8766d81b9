"""Strict reading of the rig file's schema; every complaint names file, key and remedy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn, TypeVar

import numpy as np

from closerange.errors import InputError, SchemaError
from closerange.flags import parse_flags
from closerange.geometry.arrays import FloatArray
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import POSE, Camera
from closerange.rig.distortion import (
    COEFFICIENTS,
    INTRINSICS,
    BrownIdeal,
    BrownObserved,
    Distortion,
)
from closerange.rig.rig import Residuals, Rig, Trust

SCHEMA = "closerange.rig/2"

SCHEMAS = (SCHEMA, "closerange.rig/1")
"""What is read. Version 1 knew no ``tau_px``: its positions state what detection states alone."""

INFINITE = "infinite"
"""Stands for an error without bound in ``trust``; JSON has no such number."""

RESIDUAL_COLUMNS = (
    *("camera", "placement", "point", "x_mm", "y_mm", "z_mm", "x_px", "y_px"),
    *("residual_x_px", "residual_y_px", "fitted", "flags"),
)

_SYMMETRY = 1e-6  # of sqrt(c_ii c_jj): rounding of an inverse stays below, an edited digit not
_MAX_SIZE_PX = 2**20  # no sensor is longer; larger numbers are a mistake of unit or digits
_KINDS: dict[type, str] = {dict: "an object", list: "a list", str: "a text", bool: "true or false"}

T = TypeVar("T")
Built = TypeVar("Built")


@dataclass(frozen=True, slots=True, eq=False)
class Reader:
    """A value of a parsed document that knows where it stands.

    Attributes
    ----------
    value : object
        Parsed JSON.
    source : str
        File name.
    path : str
        Key path within it, as ``cameras[1].matrix_px``.
    """

    value: Any
    source: str
    path: str = ""

    def fail(self, problem: str, remedy: str) -> NoReturn:
        """Refuse this value."""
        where = f"{self.source}, key {self.path!r}" if self.path else self.source
        raise SchemaError(f"{where}: {problem}", remedy=remedy)

    def of_type(self, kind: type[T]) -> T:
        """Return the value if it is of a type."""
        if not isinstance(self.value, kind):
            self.fail(f"expected {_KINDS[kind]}, found {_shown(self.value)}", "correct the value")
        return self.value

    def keys(self, names: Sequence[str]) -> dict[str, Reader]:
        """Return the members of an object that has exactly these keys."""
        members = self.of_type(dict)
        missing = [name for name in names if name not in members]
        if missing:
            self.fail(f"missing key {', '.join(map(repr, missing))}", "calibrate again or add it")
        unknown = [name for name in members if name not in names]
        if unknown:
            self.fail(
                f"unknown key {', '.join(map(repr, unknown[:5]))}",
                "correct its spelling or remove it; notes belong under 'provenance'",
            )
        return {name: self._member(members[name], f".{name}") for name in names}

    def items(self) -> Iterator[Reader]:
        """Return the members of a list."""
        for index, item in enumerate(self.of_type(list)):
            yield self._member(item, f"[{index}]")

    def text(self) -> str:
        """Return a non-empty text."""
        text = self.of_type(str)
        if not text:
            self.fail("the text is empty", "write a name")
        return text

    def integer(self, lowest: int, highest: int) -> int:
        """Return a whole number within bounds."""
        if isinstance(self.value, bool) or not isinstance(self.value, int):
            self.fail(f"expected a whole number, found {_shown(self.value)}", "correct the value")
        if not lowest <= self.value <= highest:
            self.fail(f"{_shown(self.value)} is not within {lowest} ... {highest}", "correct it")
        return self.value

    def number(self, *, null: bool = False) -> float:
        """Return a finite number, or NaN for null where that is allowed."""
        if self.value is None and null:
            return math.nan
        if isinstance(self.value, bool) or not isinstance(self.value, int | float):
            self.fail(f"expected a number, found {_shown(self.value)}", "write a finite number")
        try:
            number = float(self.value)
        except OverflowError:  # an integer of 400 digits
            number = math.inf
        if not math.isfinite(number):
            self.fail(f"{_shown(self.value)} is not finite", "write a finite number")
        return number

    def array(self, shape: tuple[int, ...], *, null: bool = False) -> FloatArray:
        """Return numbers in nested lists of a given shape."""
        items = self.of_type(list)
        if len(items) != shape[0]:
            self.fail(f"{len(items)} entries, expected {shape[0]}", "correct the length")
        if len(shape) == 1:
            return np.array([item.number(null=null) for item in self.items()])
        rows = [item.array(shape[1:], null=null) for item in self.items()]
        return np.array(rows).reshape(shape)

    def build(self, construct: Callable[[], Built], remedy: str) -> Built:
        """Call a constructor; what it refuses is refused here, with the key path."""
        try:
            return construct()
        except SchemaError:
            raise
        except InputError as error:
            self.fail(error.message, error.remedy or remedy)
        except ValueError as error:
            self.fail(str(error), remedy)

    def _member(self, value: Any, step: str) -> Reader:
        return Reader(value, self.source, (self.path + step).removeprefix("."))


def rig_from_reader(root: Reader) -> Rig:
    """Read a whole rig.

    Parameters
    ----------
    root : Reader
        The document.

    Returns
    -------
    Rig
        The rig.

    Raises
    ------
    SchemaError
        On the first thing that breaks the schema.
    """
    _check_schema(root)
    fields = root.keys(
        (
            *("schema", "model", "trust", "noise_px", "dof", "volume_mm", "cameras"),
            *("parameters", "parameter_cov", "report", "provenance", "residuals"),
            *(("tau_px",) if root.value["schema"] == SCHEMA else ()),
        )
    )
    cameras = tuple(_camera(item) for item in fields["cameras"].items())
    names = [camera.name for camera in cameras]
    if not names or len(set(names)) < len(names):
        fields["cameras"].fail(
            f"camera names {names} are not different, or there is none",
            "give each camera a name of its own",
        )
    parameters = _parameters(fields["parameters"], names)
    trust, tau = fields["trust"], fields.get("tau_px")
    rig = root.build(
        lambda: Rig(
            cameras=cameras,
            volume_mm=fields["volume_mm"].array((2, 3)),
            parameters=parameters,
            parameter_cov=_covariance(fields["parameter_cov"], len(parameters)),
            noise_px=_noise(fields["noise_px"]),
            tau_px=0.0 if tau is None else _not_negative(tau, null=False),
            dof=fields["dof"].integer(0, 2**53),
            model=fields["model"].text(),
            residuals=_residuals(fields["residuals"], names),
            trust=None if trust.value is None else _trust(trust),
            report=fields["report"].of_type(dict),
            provenance=fields["provenance"].of_type(dict),
        ),
        "correct the value",
    )
    _require_uncertainty(rig, fields)
    return rig


def _require_uncertainty(rig: Rig, fields: dict[str, Reader]) -> None:
    """Refuse an unknown uncertainty, unless the verdict marks all that is measured with it."""
    if rig.uncertainty_known or (rig.trust is not None and rig.trust.verdict == "untrustworthy"):
        return
    key = "noise_px" if math.isnan(rig.noise_px) else "parameter_cov" if rig.dof else "dof"
    fields[key].fail(
        "unknown: positions would have no covariance that holds, and nothing would say so",
        "calibrate again; only a rig with the verdict 'untrustworthy' may lack it",
    )


def _check_schema(root: Reader) -> None:
    """Refuse other files and other versions before looking at their keys."""
    found = root.value.get("schema") if isinstance(root.value, dict) else None
    if found in SCHEMAS:
        return
    if isinstance(found, str) and found.startswith(SCHEMA.partition("/")[0] + "/"):
        root.fail(
            f"schema {_shown(found)}, this program reads {' and '.join(map(repr, SCHEMAS))}",
            "use the version of closerange that wrote it, or calibrate again",
        )
    root.fail(
        f"not a rig file: schema {_shown(found)}, expected {SCHEMA!r}",
        "name the file that 'closerange calibrate' wrote",
    )


def _camera(reader: Reader) -> Camera:
    fields = reader.keys(("name", "size_px", "matrix_px", "distortion", "camera_from_world"))
    size = [item.integer(1, _MAX_SIZE_PX) for item in fields["size_px"].items()]
    if len(size) != 2:
        fields["size_px"].fail(f"{len(size)} entries, expected 2", "write [width, height]")
    matrix = fields["matrix_px"].array((3, 3))
    pose = fields["camera_from_world"]
    parts = pose.keys(("rotation", "translation_mm"))
    rotation, translation = parts["rotation"].array((3, 3)), parts["translation_mm"].array((3,))
    transform = pose.build(
        lambda: RigidTransform(rotation, translation),
        "use right-handed axes; write all digits of the rotation",
    )
    name, lens = fields["name"].text(), _lens(fields["distortion"])
    return fields["matrix_px"].build(
        lambda: Camera(name, (size[0], size[1]), matrix, transform, lens),
        "write [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]",
    )


def _lens(reader: Reader) -> Distortion:
    model = reader.of_type(dict).get("model")
    if model == "brown-ideal":
        fields = reader.keys(("model", *COEFFICIENTS))
        return BrownIdeal(**{name: fields[name].number() for name in COEFFICIENTS})
    if model != "brown-observed":
        reader.fail(
            f"unknown lens model {_shown(model)}",
            "use 'brown-ideal' (as OpenCV) or 'brown-observed'",
        )
    fields = reader.keys(("model", *COEFFICIENTS, "centre_px", "unit_px"))
    unit = fields["unit_px"].array((2,))
    if not unit.all():
        fields["unit_px"].fail("a unit of length 0", "write the length of the unit in px")
    return BrownObserved(
        **{name: fields[name].number() for name in COEFFICIENTS},
        centre_px=fields["centre_px"].array((2,)),
        unit_px=unit,
    )


def _parameters(reader: Reader, cameras: Sequence[str]) -> tuple[str, ...]:
    known = {*INTRINSICS, *COEFFICIENTS, *POSE}
    names: list[str] = []
    for item in reader.items():
        name = item.text()
        camera, _, parameter = name.rpartition(".")
        if camera not in cameras or parameter not in known or name in names:
            item.fail(
                f"{name!r} is not a camera of the rig, a dot and a parameter, or stands twice",
                f"parameters are {' '.join((*INTRINSICS, *COEFFICIENTS, *POSE))}",
            )
        names.append(name)
    return tuple(names)


def _covariance(reader: Reader, count: int) -> FloatArray:
    """Read a covariance; entries may be null (unknown), in pairs."""
    covariance = reader.array((count, count), null=True)
    variance = np.diag(covariance)
    if (variance < 0).any():
        worst = int(np.nanargmin(variance))
        reader.fail(f"variance {worst} is negative ({variance[worst]:.3g})", "calibrate again")
    limit = _SYMMETRY * np.sqrt(np.outer(variance, variance))
    unknown = np.isnan(covariance)
    skewed = np.abs(covariance - covariance.T) > limit
    if (skewed | (unknown != unknown.T)).any():
        row, column = np.argwhere(skewed | (unknown != unknown.T))[0]
        reader.fail(
            f"not symmetric: entries [{row}][{column}] and [{column}][{row}] differ",
            "calibrate again",
        )
    return covariance


def _not_negative(reader: Reader, *, null: bool = True) -> float:
    value = reader.number(null=null)
    if value < 0:
        reader.fail(f"{value} is negative", "correct the value")
    return value


def _noise(reader: Reader) -> float:
    value = _not_negative(reader)
    if value == 0:
        reader.fail(
            "0 px: no image is free of noise, and nothing could be weighed", "calibrate again"
        )
    return value


def _trust(reader: Reader) -> Trust:
    def bounds(item: Reader) -> list[float]:
        return [
            math.inf if value.value == INFINITE else _not_negative(value) for value in item.items()
        ]

    fields = reader.keys(("verdict", "predicted_mm", "calibration_mm", "reasons"))
    verdict, reasons = fields["verdict"].text(), fields["reasons"]
    return reader.build(
        lambda: Trust(
            verdict,
            np.array(bounds(fields["predicted_mm"])),
            np.array(bounds(fields["calibration_mm"])),
            tuple(item.text() for item in reasons.items()),
        ),
        "correct the value",
    )


def _residuals(reader: Reader, cameras: Sequence[str]) -> Residuals:
    fields = reader.keys(("columns", "rows"))
    if fields["columns"].value != list(RESIDUAL_COLUMNS):
        fields["columns"].fail(
            f"found {_shown(fields['columns'].value)}", f"write {list(RESIDUAL_COLUMNS)}"
        )
    rows = [_residual_row(row, cameras) for row in fields["rows"].items()]
    camera, placement, point, numbers, fitted, flags = zip(*rows, strict=True) if rows else [()] * 6
    values = np.array(numbers).reshape(-1, 7)
    return Residuals(
        camera=camera,
        placement=placement,
        point=point,
        xyz_mm=values[:, 0:3],
        xy_px=values[:, 3:5],
        residual_px=values[:, 5:7],
        fitted=np.array(fitted, dtype=np.bool_),
        flags=np.array(flags, dtype=np.int64),
    )


def _residual_row(
    row: Reader, cameras: Sequence[str]
) -> tuple[str, str, str, list[float], bool, int]:
    cells = list(row.items())
    if len(cells) != len(RESIDUAL_COLUMNS):
        row.fail(f"{len(cells)} entries, expected {len(RESIDUAL_COLUMNS)}", "correct the row")
    camera = cells[0].text()
    if camera not in cameras:
        cells[0].fail(f"camera {camera!r} is not in the rig", f"it has {', '.join(cameras)}")
    numbers = [cell.number(null=True) for cell in cells[3:10]]
    names = cells[11].of_type(str)
    flags = cells[11].build(lambda: parse_flags(names), "use names of the registry")
    return (
        camera,
        cells[1].of_type(str),
        cells[2].text(),
        numbers,
        cells[10].of_type(bool),
        int(flags),
    )


def _shown(value: Any) -> str:
    """Show a value in a message, shortened."""
    if isinstance(value, dict | list):
        return f"{_KINDS[type(value)]} of {len(value)}"
    if isinstance(value, int) and abs(value) > 10**20:
        return f"an integer of {value.bit_length()} bits"
    text = "nothing" if value is None else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
