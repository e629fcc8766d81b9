"""One point in full: its structuring element, the mapped form, the segment, the mismatches."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.delivery.canvas import base64_of, encode_png
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.correspondences import Correspondences
from closerange.matching.literal_element import farthest_plane, footprint
from closerange.matching.search import epipolar_segment, plane_mapping
from closerange.rig.camera import Camera

SIZES_PX = (15, 31, 59, 121)
"""Sides of elements, of which the smallest that an edge crosses is taken: those of the thesis'
examples 1 and 2, one between, and one for faces whose middle is far from their edges."""

TRIED = 200
"""Points among which one is chosen for the picture."""

AGREES_PX = 1.5
"""Distance from the program's own match within which the element's best place must lie."""

APART_PX = 3.0
"""Places nearer than this to the best one are its flank, not another answer."""

MARGIN_PX = 8
"""What is shown around elements and segments."""

_EDGE_TINT = (235, 150, 70)  # blue, green, red
_EDGE_SHARE = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """A piece of an image with its edge pixels tinted.

    Attributes
    ----------
    picture : str
        PNG, base64, one pixel for each pixel of the image.
    first_px : tuple of int
        x, y of the upper left pixel in the image.
    size_px : tuple of int
        Width and height.
    """

    picture: str
    first_px: tuple[int, int]
    size_px: tuple[int, int]

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document."""
        return {
            "png_base64": self.picture,
            "first_px": list(self.first_px),
            "size_px": list(self.size_px),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Crop:
        """Rebuild from `to_document`, which is not trusted."""
        picture = str(document["png_base64"])
        base64.b64decode(picture, validate=True)
        (x, y), (width, height) = document["first_px"], document["size_px"]
        if min(int(width), int(height)) < 1:
            raise ValueError("a crop without pixels")
        return cls(picture, (int(x), int(y)), (int(width), int(height)))


@dataclass(frozen=True, slots=True, eq=False)
class ElementPicture:
    """Figures 5.11 to 5.13 of the thesis for one point.

    Attributes
    ----------
    point : str
        Its name.
    cameras : tuple of str
        View 1 and view 2.
    size_px : int
        Side of the element in view 1.
    plane : tuple of (str, float)
        Axis and coordinate in mm of the plane that carries the element over.
    crops : tuple of Crop
        Around the point in view 1, around the match in view 2, around the segment in view 2.
    seed_px, match_px : tuple of float
        The point, and the program's own match.
    element_px : ndarray of int, shape (K, 2)
        Edge pixels of the element in view 1.
    mapped_px : ndarray of int, shape (L, 2)
        Its mapped form at the best place in view 2.
    missing : ndarray of bool, shape (L,)
        Which of those pixels are no edge pixels in view 2.
    segment_px : ndarray, shape (S, 2)
        Places of the search, from near to far.
    mismatch : ndarray of int, shape (S,)
        Pixels of the mapped element that are missing at each place.
    depth_mm : ndarray, shape (S,)
        Coordinate of each place along the plane's axis.
    """

    point: str
    cameras: tuple[str, str]
    size_px: int
    plane: tuple[str, float]
    crops: tuple[Crop, Crop, Crop]
    seed_px: tuple[float, float]
    match_px: tuple[float, float]
    element_px: IntArray
    mapped_px: IntArray
    missing: BoolArray
    segment_px: FloatArray
    mismatch: IntArray
    depth_mm: FloatArray

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document."""
        return {
            "point": self.point,
            "cameras": list(self.cameras),
            "size_px": self.size_px,
            "plane": list(self.plane),
            "crops": [crop.to_document() for crop in self.crops],
            "seed_px": list(self.seed_px),
            "match_px": list(self.match_px),
            "element_px": self.element_px.tolist(),
            "mapped_px": self.mapped_px.tolist(),
            "missing": self.missing.tolist(),
            "segment_px": self.segment_px.tolist(),
            "mismatch": self.mismatch.tolist(),
            "depth_mm": self.depth_mm.tolist(),
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> ElementPicture:
        """Rebuild from `to_document`, which is not trusted.

        Raises
        ------
        KeyError, TypeError or ValueError
            If it is no such document.
        """
        first, second = (str(name) for name in document["cameras"])
        axis, offset = document["plane"]
        crops = tuple(Crop.from_document(entry) for entry in document["crops"])
        segment = np.reshape(np.asarray(document["segment_px"], np.float64), (-1, 2))
        mapped = np.reshape(np.asarray(document["mapped_px"], np.int64), (-1, 2))
        mismatch = np.asarray(document["mismatch"], np.int64)
        depth = np.asarray(document["depth_mm"], np.float64)
        missing = np.asarray(document["missing"], np.bool_)
        if len(crops) != 3 or len({len(segment), len(mismatch), len(depth)}) != 1:
            raise ValueError("parts of an element differ in length")
        if len(missing) != len(mapped) or not len(segment):
            raise ValueError("an element without pixels or places")
        return cls(
            str(document["point"]),
            (first, second),
            int(document["size_px"]),
            (str(axis), float(offset)),
            (crops[0], crops[1], crops[2]),
            _pair(document["seed_px"]),
            _pair(document["match_px"]),
            np.reshape(np.asarray(document["element_px"], np.int64), (-1, 2)),
            mapped,
            missing,
            segment,
            mismatch,
            depth,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """The element of one point, scanned along its segment."""

    row: int
    size_px: int
    element_px: IntArray
    offsets: IntArray
    places: FloatArray
    depth_mm: FloatArray
    mismatch: IntArray

    @property
    def best(self) -> int:
        return int(np.argmin(self.mismatch))

    @property
    def margin(self) -> float:
        """How much worse the best place elsewhere is, as a share of the element."""
        away = np.linalg.norm(self.places - self.places[self.best], axis=1) >= APART_PX
        if not away.any():
            return 0.0
        return float(self.mismatch[away].min() - self.mismatch.min()) / len(self.offsets)


def element_picture(
    cameras: Sequence[Camera],
    greys: Sequence[NDArray[np.uint8]],
    masks: Sequence[BoolArray],
    matches: Correspondences,
    volume_mm: FloatArray,
    *,
    sizes_px: Sequence[int] = SIZES_PX,
) -> ElementPicture | None:
    """Choose one matched point and show how a structuring element finds it.

    Parameters
    ----------
    cameras, greys, masks : sequence of two
        Cameras, 8-bit images and edge pixels of the first two views of the matches.
    matches : Correspondences
        What the program found.
    volume_mm : ndarray, shape (2, 3)
        Where it was sought.
    sizes_px : sequence of int, optional
        Sides of elements, odd and ascending.

    Returns
    -------
    ElementPicture or None
        Of the matches without a flag, that for which the thesis' element (section 5.5) tells its
        best place most clearly from all others, the program's own match being there. None if
        there is no such point, or the volume has no limit in depth.
    """
    first, second = cameras
    plane = farthest_plane(first, second, volume_mm)
    clean = np.flatnonzero(matches.clean & matches.found[:, :2].all(axis=1))
    if not clean.size or not np.isfinite(plane[1]):
        return None
    rows = clean[:: 1 + len(clean) // TRIED]
    near = matches.select(rows)
    searches = _searches((first, second), (masks[0], masks[1]), near, volume_mm, sizes_px)
    if not searches:
        return None
    chosen = max(searches, key=lambda search: search.margin)
    return _picture(chosen, greys, masks, near, ("XYZ"[plane[0]], plane[1]))


def _searches(
    cameras: tuple[Camera, Camera],
    masks: tuple[BoolArray, BoolArray],
    matches: Correspondences,
    volume_mm: FloatArray,
    sizes_px: Sequence[int],
) -> list[_Search]:
    """Scan the elements of points; keep those that agree with the program's matches."""
    axis, offset = farthest_plane(*cameras, volume_mm)
    seeds = matches.xy_px[:, 0]
    segments = epipolar_segment(*cameras, seeds, volume_mm)
    depth_mm = segments.xyz_mm[..., axis]
    found = []
    for row in range(len(matches)):
        size_px, element = _element(masks[0], seeds[row], sizes_px)
        count = int(segments.count[row])
        if not len(element) or count == 0:
            continue
        both = np.concatenate([element, np.rint(seeds[row])[None]]).astype(np.float64)
        mapped = plane_mapping(*cameras, both, normal=np.eye(3)[axis], offset_mm=offset).xy_px
        if not all_finite(mapped, (0, 1)):
            continue
        offsets = np.unique(np.rint(mapped[:-1] - mapped[-1]).astype(np.int64), axis=0)
        places = segments.xy_px[row, :count]
        present = _present(masks[1], np.rint(places).astype(np.int64)[:, None] + offsets)
        search = _Search(
            row,
            size_px,
            element,
            offsets,
            places,
            depth_mm[row, :count],
            np.asarray((~present).sum(axis=1), np.int64),
        )
        away = np.linalg.norm(places[search.best] - matches.xy_px[row, 1])
        if away <= AGREES_PX:
            found.append(search)
    return found


def _element(mask: BoolArray, seed_px: FloatArray, sizes_px: Sequence[int]) -> tuple[int, IntArray]:
    """Return side and edge pixels of the smallest element that an edge crosses."""
    centre = np.rint(seed_px).astype(np.int64)
    ys, xs = np.nonzero(footprint(sizes_px[-1]))
    reach = sizes_px[-1] // 2
    around = np.column_stack([xs - reach, ys - reach])
    around = around[_present(mask, around + centre)]
    for size in sizes_px:
        inside = around[np.abs(around).max(axis=1, initial=0) <= size // 2]
        if len(inside) >= size:
            return size, np.asarray(inside + centre, np.int64)
    return sizes_px[-1], np.asarray(around + centre, np.int64)


def _present(mask: BoolArray, pixel: IntArray) -> BoolArray:
    """Tell which pixels x, y are edge pixels; none outside of the image is."""
    height, width = mask.shape
    x, y = pixel[..., 0], pixel[..., 1]
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(inside & mask[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)])


def _picture(
    search: _Search,
    greys: Sequence[NDArray[np.uint8]],
    masks: Sequence[BoolArray],
    matches: Correspondences,
    plane: tuple[str, float],
) -> ElementPicture:
    """Cut the three pictures."""
    seed, match = matches.xy_px[search.row, 0], matches.xy_px[search.row, 1]
    mapped = np.rint(search.places[search.best]).astype(np.int64) + search.offsets
    half = search.size_px // 2
    corners = np.rint(seed) + np.array([[-half, -half], [half, half]])
    return ElementPicture(
        point=matches.point[search.row],
        cameras=(matches.cameras[0], matches.cameras[1]),
        size_px=search.size_px,
        plane=plane,
        crops=(
            _crop(greys[0], masks[0], corners),
            _crop(greys[1], masks[1], np.concatenate([mapped, match[None]])),
            _crop(greys[1], masks[1], np.concatenate([search.places, mapped])),
        ),
        seed_px=_pair(seed),
        match_px=_pair(match),
        element_px=search.element_px,
        mapped_px=mapped,
        missing=~_present(masks[1], mapped),
        segment_px=np.round(search.places, 3),  # enough for a picture
        mismatch=search.mismatch,
        depth_mm=np.round(search.depth_mm, 4),
    )


def _crop(grey: NDArray[np.uint8], mask: BoolArray, around_px: FloatArray) -> Crop:
    """Cut out what lies around points, squarely, with the edge pixels tinted."""
    height, width = mask.shape
    low, high = np.floor(around_px.min(axis=0)), np.ceil(around_px.max(axis=0))
    side = int((high - low).max()) + 1 + 2 * MARGIN_PX
    middle = (low + high) / 2
    start = np.rint(middle - side / 2).astype(np.int64)
    x0, y0 = (int(value) for value in np.maximum(start, 0))
    x1, y1 = min(int(start[0]) + side, width), min(int(start[1]) + side, height)
    colour = cv2.cvtColor(np.ascontiguousarray(grey[y0:y1, x0:x1]), cv2.COLOR_GRAY2BGR)
    tinted = colour * (1 - _EDGE_SHARE) + np.array(_EDGE_TINT) * _EDGE_SHARE
    picture = np.where(mask[y0:y1, x0:x1, None], np.rint(tinted), colour).astype(np.uint8)
    return Crop(base64_of(encode_png(picture)), (x0, y0), (x1 - x0, y1 - y0))


def _pair(values: Any) -> tuple[float, float]:
    x, y = (float(value) for value in values)
    return x, y
