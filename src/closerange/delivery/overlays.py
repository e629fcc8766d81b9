"""What was detected, drawn on the image itself."""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from closerange.delivery.plots import magnification
from closerange.delivery.svg import FULL_WIDTH, Drawing, units
from closerange.errors import InputError, SchemaError
from closerange.features.image_points import ImagePoints
from closerange.flags import format_flags
from closerange.geometry.arrays import FloatArray, IntArray, frozen_array, frozen_ints
from closerange.images.frame import Frame
from closerange.rig.rig import Residuals

SCHEMA = "closerange.overlay/1"

SMALL_PX = 400
"""Crops up to this long are shown a quarter of the page wide, larger images half."""

MAX_WIDTH_PX = 640
"""Width of the stored picture: 90 mm on paper at 180 dpi, which is what a page can show."""

# quality 80 keeps the noise of a 640 x 512 picture below 90 kB; the drawing on top is exact
_JPEG_QUALITY = 80

# bright on grey pictures and different in lightness, with dark outlines around them
FOUND, FLAGGED, VECTOR = "#00d5ff", "#ff9f1c", "#ffe14d"


@dataclass(frozen=True, slots=True, eq=False)
class Overlay:
    """A small picture of a frame with the points found on it; N points.

    Attributes
    ----------
    camera, placement, source : str
        Which frame it is.
    size_px : tuple of int
        Width and height of the full image; all coordinates refer to it.
    picture : str
        JPEG of at most `MAX_WIDTH_PX` columns, base64.
    point : tuple of str
        Names.
    xy_px : ndarray, shape (N, 2)
        Positions; NaN where not found.
    ellipse : ndarray, shape (N, 3)
        Semi-axes a >= b in px and angle of a in rad; NaN for other features.
    flags : ndarray of int, shape (N,)
        `Flag` bits.
    residual_px : ndarray, shape (N, 2)
        Observed minus calculated; NaN where not known.
    """

    camera: str
    placement: str
    source: str
    size_px: tuple[int, int]
    picture: str
    point: tuple[str, ...]
    xy_px: FloatArray
    ellipse: FloatArray
    flags: IntArray
    residual_px: FloatArray

    def __post_init__(self) -> None:
        count = len(self.point)
        for name, width in (("xy_px", 2), ("ellipse", 3), ("residual_px", 2)):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count, width), name))
        object.__setattr__(self, "flags", frozen_ints(self.flags, (count,), "flags"))
        object.__setattr__(self, "point", tuple(self.point))
        object.__setattr__(self, "size_px", (int(self.size_px[0]), int(self.size_px[1])))

    @property
    def small(self) -> bool:
        """Whether it is a crop that needs little room."""
        return max(self.size_px) <= SMALL_PX

    @property
    def file_name(self) -> str:
        """Name of the image file; its folder is the machine's, not the measurement's."""
        return self.source.replace("\\", "/").rpartition("/")[2]

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document; NaN becomes None."""
        return {
            "schema": SCHEMA,
            "camera": self.camera,
            "placement": self.placement,
            "source": self.source,
            "size_px": list(self.size_px),
            "picture_jpeg_base64": self.picture,
            "point": list(self.point),
            "xy_px": _without_nan(self.xy_px),
            "ellipse": _without_nan(self.ellipse),
            "flags": self.flags.tolist(),
            "residual_px": _without_nan(self.residual_px),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Overlay:
        """Rebuild from `to_document`.

        Parameters
        ----------
        document : mapping
            Parsed JSON; it is not trusted.

        Returns
        -------
        Overlay
            The same overlay.

        Raises
        ------
        SchemaError
            If it is not such a document.
        """
        if document.get("schema") != SCHEMA:
            raise SchemaError(
                f"overlay: schema is {document.get('schema')!r}, expected {SCHEMA!r}",
                remedy="write the result again with this version of the program",
            )
        try:
            picture = str(document["picture_jpeg_base64"])
            base64.b64decode(picture, validate=True)
            width, height = document["size_px"]
            return cls(
                camera=str(document["camera"]),
                placement=str(document["placement"]),
                source=str(document["source"]),
                size_px=(int(width), int(height)),
                picture=picture,
                point=tuple(str(name) for name in document["point"]),
                xy_px=_with_nan(document["xy_px"], 2),
                ellipse=_with_nan(document["ellipse"], 3),
                flags=np.asarray(document["flags"], np.int64),
                residual_px=_with_nan(document["residual_px"], 2),
            )
        except (KeyError, TypeError, ValueError, binascii.Error) as error:
            raise SchemaError(
                f"overlay: malformed document ({type(error).__name__}: {error})",
                remedy="write the result again with this version of the program",
            ) from error


def make_overlay(
    frame: Frame,
    points: ImagePoints,
    *,
    placement: str | None = None,
    reading: str | None = None,
    residuals: Residuals | None = None,
) -> Overlay:
    """Put a frame and its points together for a report.

    Parameters
    ----------
    frame : Frame
        The image.
    points : ImagePoints
        Any table; the rows of the frame's camera and of one placement are taken.
    placement : str, optional
        Which placement; not needed if the camera's rows are all of one.
    reading : str, optional
        Which reading; the first one of the table without it.
    residuals : Residuals, optional
        Of a calibration; drawn as vectors on the points that it knows.

    Returns
    -------
    Overlay
        Small enough for a report of many frames.

    Raises
    ------
    InputError
        If the camera's rows are of several placements and none is named.
    """
    chosen = points.select(np.array([row == frame.camera for row in points.camera], np.bool_))
    placements = sorted(set(chosen.placement))
    if placement is None and len(placements) > 1:
        raise InputError(
            f"camera {frame.camera!r} has points of {len(placements)} placements "
            f"({placements[0]!r}, {placements[1]!r}, ...); a picture shows one",
            remedy="name the placement of this frame",
        )
    name = placement if placement is not None else (placements or [""])[0]
    chosen = chosen.select(np.array([row == name for row in chosen.placement], np.bool_))
    wanted = reading if reading is not None else next(iter(chosen.reading), "")
    chosen = chosen.select(np.array([row == wanted for row in chosen.reading], np.bool_))
    return Overlay(
        camera=frame.camera,
        placement=name,
        source=frame.source,
        size_px=frame.size_px,
        picture=_jpeg(frame),
        point=chosen.point,
        xy_px=chosen.xy_px,
        ellipse=chosen.ellipse,
        flags=chosen.flags,
        residual_px=_residuals_of(chosen, residuals),
    )


def draw_overlay(overlay: Overlay, *, factor: float = 1.0) -> Markup:
    """Draw an overlay half a page wide; a small one a quarter.

    Parameters
    ----------
    overlay : Overlay
        Picture and points.
    factor : float, optional
        Magnification of the residual vectors; see `common_factor`.

    Returns
    -------
    Markup
        Inline SVG: the picture, ellipses or crosses, names, and residual vectors.
    """
    width, height = overlay.size_px
    paper = FULL_WIDTH / (4 if overlay.small else 2)
    scale = paper / width
    found = np.asarray(np.isfinite(overlay.xy_px).all(axis=1))
    flagged = int((overlay.flags != 0).sum())
    drawing = Drawing(
        paper,
        height * scale,
        f"Camera {overlay.camera}{overlay.placement and ', placement ' + overlay.placement}",
        f"{int(found.sum())} of {len(found)} points found, {flagged} flagged",
    )
    drawing.add(
        "image",
        x=0,
        y=0,
        width=paper,
        height=height * scale,
        preserveAspectRatio="none",
        href=f"data:image/jpeg;base64,{overlay.picture}",
    )
    for row in np.flatnonzero(found):
        # pixel (0, 0) is a centre: the picture's corner is at (-0.5, -0.5)
        at = ((overlay.xy_px[row, 0] + 0.5) * scale, (overlay.xy_px[row, 1] + 0.5) * scale)
        colour = FLAGGED if overlay.flags[row] else FOUND
        _draw_mark(drawing, at, overlay.ellipse[row] * (scale, scale, 1.0), colour)
        residual = overlay.residual_px[row] * scale * factor
        if np.isfinite(residual).all():
            tip = (at[0] + residual[0], at[1] + residual[1])
            drawing.arrow(at, tip, "#000000", stroke_width=3)
            drawing.arrow(at, tip, VECTOR, stroke_width=1.2)
        _draw_name(drawing, at, overlay, int(row), scale, colour)
    return drawing.render()


def common_factor(overlays: Sequence[Overlay]) -> float:
    """Choose one magnification for the residual vectors of several overlays.

    Parameters
    ----------
    overlays : sequence of Overlay
        At least one.

    Returns
    -------
    float
        A round number; one for all, so that pictures can be compared.
    """
    lengths = [np.linalg.norm(overlay.residual_px, axis=1) for overlay in overlays]
    most = max(overlays, key=lambda overlay: int(np.isfinite(overlay.residual_px).sum()))
    count = int(np.isfinite(most.residual_px).all(axis=1).sum())
    return magnification(np.concatenate(lengths), most.size_px, count=count)


def _draw_mark(drawing: Drawing, at: tuple[float, float], ellipse: FloatArray, colour: str) -> None:
    """Draw the image ellipse of a disc, or a cross for anything else."""
    x, y = at
    if np.isfinite(ellipse).all():
        turn = f"rotate({units(math.degrees(ellipse[2]))} {units(x)} {units(y)})"
        for stroke, width in (("#000000", 2.2), (colour, 1.1)):
            drawing.add(
                "ellipse",
                cx=x,
                cy=y,
                rx=float(ellipse[0]),
                ry=float(ellipse[1]),
                transform=turn,
                fill="none",
                stroke=stroke,
                stroke_width=width,
            )
    for stroke, width in (("#000000", 2.0), (colour, 0.9)):
        drawing.line((x - 3, y), (x + 3, y), stroke, stroke_width=width)
        drawing.line((x, y - 3), (x, y + 3), stroke, stroke_width=width)


def _draw_name(
    drawing: Drawing,
    at: tuple[float, float],
    overlay: Overlay,
    row: int,
    scale: float,
    colour: str,
) -> None:
    """Write the name beside a point; without it where more than 60 names would hide the image."""
    if len(overlay.point) > 60 and not overlay.flags[row]:
        return
    size = overlay.ellipse[row, 0] * scale
    away = (size if math.isfinite(size) else 4.0) * 0.72 + 3
    name = overlay.point[row]
    if overlay.flags[row]:
        name = f"{name}: {format_flags(int(overlay.flags[row]))}"
    right = at[0] > 0.8 * drawing.width
    drawing.text(
        (at[0] - away if right else at[0] + away, at[1] - away),
        name,
        text_anchor="end" if right else "start",
        fill=colour,
        stroke="#000000",
        stroke_width=2.2,
        paint_order="stroke",
        font_size=9,
    )


def _jpeg(frame: Frame) -> str:
    """Encode a frame as a small 8-bit JPEG, base64."""
    pixels: NDArray[Any] = frame.pixels
    if pixels.dtype == np.uint16:
        # cameras of 10 or 12 bits leave the upper bits empty: the brightest pixel becomes white
        pixels = np.rint(pixels * (255.0 / max(int(pixels.max()), 1))).astype(np.uint8)
    width, height = frame.size_px
    if width > MAX_WIDTH_PX:
        size = (MAX_WIDTH_PX, max(1, round(height * MAX_WIDTH_PX / width)))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return base64.b64encode(encoded.tobytes()).decode("ascii")


def _residuals_of(points: ImagePoints, residuals: Residuals | None) -> FloatArray:
    """Look up each point's residual; NaN where there is none."""
    vectors = np.full((len(points), 2), np.nan)
    if residuals is None:
        return vectors
    keys = zip(residuals.camera, residuals.placement, residuals.point, strict=True)
    rows = {key: row for row, key in enumerate(keys)}
    for index, key in enumerate(zip(points.camera, points.placement, points.point, strict=True)):
        if key in rows:
            vectors[index] = residuals.residual_px[rows[key]]
    return vectors


def _without_nan(values: FloatArray) -> list[list[float | None]]:
    return [[v if math.isfinite(v) else None for v in row] for row in values.tolist()]


def _with_nan(rows: list[list[float | None]], width: int) -> FloatArray:
    numbers = [[math.nan if v is None else float(v) for v in row] for row in rows]
    return np.reshape(np.asarray(numbers, np.float64), (-1, width))
