"""A drawing that can be painted: as SVG in a report, as PNG in a folder of pictures."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.delivery.svg import INK, Drawing, Point, units
from closerange.delivery.wording import DASH, TIMES
from closerange.geometry.arrays import FloatArray, all_finite

Pixels = NDArray[np.uint8]

PAINT_SCALE = 2.0
"""Pixels of a painted picture for each drawing unit: 1280 px for the width of a page."""

_SHIFT = 4  # OpenCV's fixed-point coordinates: sixteenths of a pixel
_HERSHEY_HEIGHT = 30.0  # units of the font that stand for its size
_LETTER = 0.48  # mean width of a letter per font size, as of the sans serif fonts of pages
# the painter's font has no other letters
_ASCII = str.maketrans(
    {"\u00b5": "u", TIMES: "x", "\u00b1": "+-", DASH: "-", "\u00b2": "2", "\u2212": "-"}
)


@dataclass(slots=True)
class Canvas(Drawing):
    """A drawing whose shapes are kept, so that it can be painted into pixels as well.

    What is painted: rectangles, lines, circles, chains of lines, texts without rotation, pictures,
    and the three methods below. Other elements appear in the SVG only.
    """

    _shapes: list[tuple[str, str, dict[str, Any]]] = field(default_factory=list)

    def add(self, tag: str, content: str = "", /, **attributes: str | float) -> None:
        """Append an element; see `Drawing.add`."""
        Drawing.add(self, tag, content, **attributes)
        self._shapes.append((tag, content, dict(attributes)))

    def picture(self, corner: Point, size: Point, pixels_base64: str, kind: str) -> None:
        """Put a JPEG or PNG, base64, into a rectangle.

        Parameters
        ----------
        corner, size : tuple of float
            Upper left corner, width and height in drawing units.
        pixels_base64 : str
            The encoded file.
        kind : str
            ``jpeg`` or ``png``; the pixels of a PNG stay squares however large they become.
        """
        style: dict[str, str] = {"image_rendering": "pixelated"} if kind == "png" else {}
        self.add(
            "image",
            x=corner[0],
            y=corner[1],
            width=size[0],
            height=size[1],
            preserveAspectRatio="none",
            href=f"data:image/{kind};base64,{pixels_base64}",
            **style,
        )

    def dots(self, points: Sequence[Point], radius: float, colour: str) -> None:
        """Draw many dots of one colour as one element."""
        # a line without length and with round ends is a dot, in a tenth of the characters
        steps = "".join(f"M{units(x)} {units(y)}h0" for x, y in points)
        self._joined(
            "dots", steps, points, stroke=colour, stroke_width=2 * radius, stroke_linecap="round"
        )

    def segments(
        self, pairs: Sequence[tuple[Point, Point]], colour: str, width: float, opacity: float = 1.0
    ) -> None:
        """Draw many lines of one colour as one element."""
        steps = "".join(
            f"M{units(a[0])} {units(a[1])}L{units(b[0])} {units(b[1])}" for a, b in pairs
        )
        self._joined(
            "segments", steps, pairs, stroke=colour, stroke_width=width, stroke_opacity=opacity
        )

    def squares(self, centres: Sequence[Point], side: float, **style: str | float) -> None:
        """Draw many upright squares of one style as one element."""
        half = side / 2
        steps = "".join(
            f"M{units(x - half)} {units(y - half)}h{units(side)}v{units(side)}h{units(-side)}z"
            for x, y in centres
        )
        self._joined("squares", steps, centres, side=side, **style)

    def paint(self, scale: float = PAINT_SCALE) -> Pixels:
        """Paint the drawing.

        Parameters
        ----------
        scale : float, optional
            Pixels for each drawing unit.

        Returns
        -------
        ndarray of uint8, shape (H, W, 3)
            Blue, green, red.
        """
        size = (round(self.height * scale), round(self.width * scale), 3)
        painter = _Painter(np.full(size, 255, np.uint8), scale)
        for tag, content, attributes in self._shapes:
            painter.shape(tag, content, attributes)
        return painter.pixels

    def _joined(self, kind: str, steps: str, where: Any, **style: Any) -> None:
        """Write one path for many marks; the marks themselves are kept for painting."""
        if not len(where):
            return
        written = {name: value for name, value in style.items() if name != "side"}
        written.setdefault("fill", "none")
        Drawing.add(self, "path", d=steps, **written)
        self._shapes.append((kind, "", {"where": where, **style}))


def encode_png(pixels: NDArray[Any]) -> bytes:
    """Encode pixels as PNG, with or without a channel of opacity."""
    _, encoded = cv2.imencode(".png", pixels)
    return encoded.tobytes()


def base64_of(data: bytes) -> str:
    """Return bytes as text for a page or a JSON file."""
    return base64.b64encode(data).decode("ascii")


class _Painter:
    """Draws shapes into pixels."""

    def __init__(self, pixels: Pixels, scale: float) -> None:
        self.pixels, self.scale = pixels, scale
        self._known: dict[str, Callable[[str, dict[str, Any]], None]] = {
            "rect": self._rect,
            "line": self._line,
            "circle": self._circle,
            "polyline": self._chain,
            "polygon": self._polygon,
            "text": self._text,
            "image": self._image,
            "dots": self._dots,
            "segments": self._segments,
            "squares": self._squares,
        }

    def shape(self, tag: str, content: str, attributes: dict[str, Any]) -> None:
        if tag in self._known:
            self._known[tag](content, attributes)

    def _at(self, points: Any) -> NDArray[np.int32]:
        """Return fixed-point pixels of drawing units, whose origin is a corner."""
        scaled = np.asarray(points, np.float64).reshape(-1, 2) * self.scale - 0.5
        return np.asarray(np.rint(scaled * 2**_SHIFT), np.int32)

    def _width(self, style: dict[str, Any]) -> int:
        return max(1, round(float(style.get("stroke_width", 1)) * self.scale))

    def _blend(self, style: dict[str, Any], name: str, draw: Callable[[Pixels], None]) -> None:
        """Draw on a copy, and mix it in by the opacity of the style."""
        opacity = float(style.get(f"{name}_opacity", 1))
        if opacity >= 1:
            draw(self.pixels)
            return
        over = self.pixels.copy()
        draw(over)
        self.pixels[:] = cv2.addWeighted(over, opacity, self.pixels, 1 - opacity, 0)

    def _polygons(
        self, rings: list[NDArray[np.int32]], style: dict[str, Any], closed: bool
    ) -> None:
        fill, stroke = style.get("fill", INK if closed else "none"), style.get("stroke", "none")
        if fill != "none":
            colour = _bgr(str(fill))
            self._blend(
                style, "fill", lambda to: cv2.fillPoly(to, rings, colour, cv2.LINE_AA, _SHIFT)
            )
        if stroke != "none":
            ink, width = _bgr(str(stroke)), self._width(style)
            self._blend(
                style,
                "stroke",
                lambda to: cv2.polylines(to, rings, closed, ink, width, cv2.LINE_AA, _SHIFT),
            )

    def _rect(self, _: str, style: dict[str, Any]) -> None:
        x, y, w, h = (float(style[name]) for name in ("x", "y", "width", "height"))
        ring = self._at([(x, y), (x + w, y), (x + w, y + h), (x, y + h)])
        self._polygons([ring], style, closed=True)

    def _line(self, _: str, style: dict[str, Any]) -> None:
        ends = self._at([(style["x1"], style["y1"]), (style["x2"], style["y2"])])
        self._polygons([ends], {**style, "fill": "none"}, closed=False)

    def _chain(self, _: str, style: dict[str, Any]) -> None:
        self._polygons([self._corners(style)], style, closed=False)

    def _polygon(self, _: str, style: dict[str, Any]) -> None:
        self._polygons([self._corners(style)], style, closed=True)

    def _corners(self, style: dict[str, Any]) -> NDArray[np.int32]:
        return self._at([float(text) for text in re.split(r"[ ,]+", str(style["points"]).strip())])

    def _circle(self, _: str, style: dict[str, Any]) -> None:
        centre = self._at([(style["cx"], style["cy"])])[0]
        radius = max(1, round(float(style["r"]) * self.scale * 2**_SHIFT))
        colour = _bgr(str(style.get("fill", INK)))
        at = (int(centre[0]), int(centre[1]))
        cv2.circle(self.pixels, at, radius, colour, -1, cv2.LINE_AA, _SHIFT)

    def _text(self, content: str, style: dict[str, Any]) -> None:
        if "transform" in style:
            return
        text = content.translate(_ASCII).encode("ascii", "replace").decode()
        size = float(style.get("font_size", 11)) * self.scale / _HERSHEY_HEIGHT
        bold = style.get("font_weight") == "bold"
        thick = max(1, round(size * (3.4 if bold else 2)))
        font = cv2.FONT_HERSHEY_SIMPLEX
        (width, _), _ = cv2.getTextSize(text, font, size, thick)
        # OpenCV 4 has a wider font than a page: its texts would run into each other
        room = _LETTER * float(style.get("font_size", 11)) * self.scale * len(text)
        if style.get("text_anchor", "start") == "start":
            room = min(room, self.pixels.shape[1] - float(style["x"]) * self.scale)
        if width > room:
            size *= room / width
            width = room
        share = {"middle": 0.5, "end": 1.0}.get(str(style.get("text_anchor", "start")), 0.0)
        at = (
            round(float(style["x"]) * self.scale - share * width),
            round(float(style["y"]) * self.scale),
        )
        if "stroke" in style:
            halo = thick + round(float(style.get("stroke_width", 1)) * self.scale)
            cv2.putText(
                self.pixels, text, at, font, size, _bgr(str(style["stroke"])), halo, cv2.LINE_AA
            )
        colour = _bgr(str(style.get("fill", INK)))
        cv2.putText(self.pixels, text, at, font, size, colour, thick, cv2.LINE_AA)

    def _image(self, _: str, style: dict[str, Any]) -> None:
        data = base64.b64decode(str(style["href"]).partition(",")[2])
        found = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if found is None:
            return
        left, top = (round(float(style[name]) * self.scale) for name in ("x", "y"))
        right = round((float(style["x"]) + float(style["width"])) * self.scale)
        bottom = round((float(style["y"]) + float(style["height"])) * self.scale)
        square = style.get("image_rendering") == "pixelated" and found.ndim < 4
        how = cv2.INTER_NEAREST if square else cv2.INTER_LINEAR
        found = cv2.resize(found, (right - left, bottom - top), interpolation=how)
        if found.ndim == 2:
            found = cv2.cvtColor(found, cv2.COLOR_GRAY2BGR)
        region = self.pixels[top:bottom, left:right]
        found = found[: region.shape[0], : region.shape[1]]
        opaque = found[..., 3:] / 255 if found.shape[2] == 4 else np.ones((1, 1, 1))
        region[:] = np.rint(opaque * found[..., :3] + (1 - opaque) * region)

    def _dots(self, _: str, style: dict[str, Any]) -> None:
        radius = max(1, round(float(style["stroke_width"]) / 2 * self.scale * 2**_SHIFT))
        colour = _bgr(str(style["stroke"]))
        for x, y in self._at(style["where"]).tolist():
            cv2.circle(self.pixels, (x, y), radius, colour, -1, cv2.LINE_AA, _SHIFT)

    def _segments(self, _: str, style: dict[str, Any]) -> None:
        ends = self._at(style["where"]).reshape(-1, 2, 2)
        self._polygons(list(ends), {**style, "fill": "none"}, closed=False)

    def _squares(self, _: str, style: dict[str, Any]) -> None:
        half = float(style["side"]) / 2
        corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
        centres = np.asarray(style["where"], np.float64).reshape(-1, 1, 2)
        rings = self._at(centres + corners).reshape(-1, 4, 2)
        self._polygons(list(rings), {"fill": "none", **style}, closed=True)


def _bgr(colour: str) -> tuple[int, int, int]:
    """Return ``#rrggbb`` as OpenCV takes it."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return blue, green, red


def dot_layer(
    size_px: tuple[int, int], xy_px: FloatArray, colours: Sequence[str], *, radius: float
) -> str:
    """Draw thousands of points as one picture with a transparent ground.

    Parameters
    ----------
    size_px : tuple of int
        Width and height of the layer.
    xy_px : ndarray, shape (N, 2)
        Where, in pixels of the layer; NaN is left out.
    colours : sequence of str
        N colours, ``#rrggbb``; later points cover earlier ones.
    radius : float
        Of a dot in pixels of the layer.

    Returns
    -------
    str
        PNG, base64: its size is limited by the layer's, whatever the number of points.
    """
    layer = np.zeros((size_px[1], size_px[0], 4), np.uint8)
    around = max(1, round(radius * 2**_SHIFT))
    known = all_finite(xy_px, 1)
    at = np.rint(np.where(known[:, None], xy_px, 0.0) * 2**_SHIFT).astype(np.int32)
    for row in np.flatnonzero(known).tolist():
        place = (int(at[row, 0]), int(at[row, 1]))
        # without smoothing: few colours and hard borders, which PNG stores in a fifth of the room
        cv2.circle(layer, place, around, (*_bgr(colours[row]), 255), -1, cv2.LINE_8, _SHIFT)
    return base64_of(encode_png(layer))
