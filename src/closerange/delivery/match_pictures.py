"""What a match saw: both images, their edge strength, one structuring element and its search."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.delivery.canvas import base64_of
from closerange.delivery.element_picture import SIZES_PX, ElementPicture, element_picture
from closerange.delivery.overlays import MAX_WIDTH_PX
from closerange.errors import SchemaError
from closerange.features.edge_operators import blur_minimum, edge_mask
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.images.frame import Frame
from closerange.matching.correspondences import Correspondences
from closerange.rig.rig import Rig

SCHEMA = "closerange.match-pictures/1"

DIM = 0.5
"""Brightness that is left to an image under coloured points: they outshine it then."""

LIFT = 0.7
"""Exponent that lifts dark greys: half of white leaves little of them."""

_QUALITY = 78  # of JPEG: the points are drawn on top, not compressed with the picture

_SOFT, _FIRM = (165, 165, 165), (60, 20, 120)
"""Blue, green, red of edge strengths just below the threshold and far above it."""

_FAR_ABOVE = 5.0
"""Threshold multiples at which edge strength is drawn in its full colour."""


@dataclass(frozen=True, slots=True)
class ViewPicture:
    """One camera's image and its edge strength, small enough for a report.

    Attributes
    ----------
    camera, source : str
        Whose image it is, and its file.
    size_px : tuple of int
        Width and height of the full image; all coordinates refer to it.
    grey, strength : str
        The image, dimmed, and its edge strength, as JPEG, base64.
    threshold : float
        Edge strength from which a pixel is an edge pixel, grey levels.
    edge_share : float
        Share of the pixels that are.
    """

    camera: str
    source: str
    size_px: tuple[int, int]
    grey: str
    strength: str
    threshold: float
    edge_share: float


@dataclass(frozen=True, slots=True, eq=False)
class ScenePictures:
    """The pictures of one matched scene.

    Attributes
    ----------
    method : str
        ``default``, or ``literal`` for that of the thesis.
    volume_mm : tuple of (tuple of float or None)
        Lower and upper corner of where points were sought; None where there was no limit.
    views : tuple of ViewPicture
        In the order of the matches' cameras.
    element : ElementPicture or None
        One chosen point; None where no point has a match to show.
    centroids : tuple of mapping
        For matched centroids: ``point``, ``seed_px``, ``match_px``, ``found_px`` (that of the
        same face in the second view) and ``expected_px``; see `closerange.workflows.match_scene`.
    """

    method: str
    volume_mm: tuple[tuple[float | None, ...], ...]
    views: tuple[ViewPicture, ...]
    element: ElementPicture | None
    centroids: tuple[Mapping[str, Any], ...] = ()

    def view(self, camera: str) -> ViewPicture | None:
        """Return the pictures of one camera."""
        return next((view for view in self.views if view.camera == camera), None)

    def to_document(self) -> dict[str, Any]:
        """Return a JSON-ready document."""
        return {
            "schema": SCHEMA,
            "method": self.method,
            "volume_mm": [list(corner) for corner in self.volume_mm],
            "views": [
                {
                    "camera": view.camera,
                    "source": view.source,
                    "size_px": list(view.size_px),
                    "grey_jpeg_base64": view.grey,
                    "strength_jpeg_base64": view.strength,
                    "threshold": view.threshold,
                    "edge_share": view.edge_share,
                }
                for view in self.views
            ],
            "element": None if self.element is None else self.element.to_document(),
            "centroids": [dict(entry) for entry in self.centroids],
        }

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> ScenePictures:
        """Rebuild from `to_document`.

        Parameters
        ----------
        document : mapping
            Parsed JSON; it is not trusted.

        Returns
        -------
        ScenePictures
            The same pictures.

        Raises
        ------
        SchemaError
            If it is not such a document.
        """
        remedy = "run it again with this version of the program"
        if document.get("schema") != SCHEMA:
            raise SchemaError(
                f"match pictures: schema is {document.get('schema')!r}, expected {SCHEMA!r}",
                remedy=remedy,
            )
        try:
            low, high = document["volume_mm"]
            element = document["element"]
            return cls(
                str(document["method"]),
                (_corner(low), _corner(high)),
                tuple(_view(entry) for entry in document["views"]),
                None if element is None else ElementPicture.from_document(element),
                tuple(_centroid(entry) for entry in document["centroids"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError, binascii.Error) as error:
            raise SchemaError(
                f"match pictures: malformed document ({type(error).__name__}: {error})",
                remedy=remedy,
            ) from error


def scene_pictures(
    rig: Rig,
    frames: Sequence[Frame],
    matches: Correspondences,
    volume_mm: FloatArray,
    *,
    method: str = "default",
    element_px: int | None = None,
    centroids: Sequence[Mapping[str, Any]] = (),
) -> ScenePictures:
    """Make the pictures of a matched scene.

    Parameters
    ----------
    rig : Rig
        Calibrated cameras.
    frames : sequence of Frame
        One image of each camera of the matches.
    matches : Correspondences
        What was found.
    volume_mm : ndarray, shape (2, 3)
        Where it was sought; infinite where there was no limit.
    method : str, optional
        How it was sought: ``default`` or ``literal``.
    element_px : int, optional
        Side of the structuring element that is shown; chosen for each point without it.
    centroids : sequence of mapping, optional
        See `ScenePictures`.

    Returns
    -------
    ScenePictures
        About 150 kB for each camera, whatever the size of the images.
    """
    by_name = {frame.camera: frame for frame in frames}
    ordered = [by_name[name] for name in matches.cameras]
    masks, views = [], []
    for frame in ordered:
        mask, report = edge_mask(frame.pixels)
        masks.append(mask)
        views.append(
            ViewPicture(
                camera=frame.camera,
                source=frame.source,
                size_px=frame.size_px,
                grey=_jpeg(_small(dimmed(frame.pixels))),
                strength=_jpeg(_small(_strength_picture(frame.pixels, mask, report.threshold))),
                threshold=float(report.threshold),
                edge_share=float(mask.mean()),
            )
        )
    limits = tuple(
        tuple(float(value) if np.isfinite(value) else None for value in corner)
        for corner in volume_mm
    )
    element = element_picture(
        [rig.camera(frame.camera) for frame in ordered[:2]],
        [dimmed(frame.pixels) for frame in ordered[:2]],
        masks[:2],
        matches,
        volume_mm,
        sizes_px=SIZES_PX if element_px is None else (element_px,),
    )
    return ScenePictures(method, limits, tuple(views), element, tuple(centroids))


def dimmed(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return an image as 8 bit, its brightest pixels at half of white.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values, uint8 or uint16.

    Returns
    -------
    ndarray of uint8, shape (H, W)
        For a ground on which coloured points stand out.
    """
    # the brightest thousandth may be glints; and dark parts need more light than they have
    top = max(float(np.quantile(pixels, 0.999)), 1.0)
    lit = np.minimum(pixels / top, 1.0) ** LIFT
    return np.asarray(np.rint(255 * DIM * lit), np.uint8)


def _strength_picture(pixels: NDArray[Any], mask: BoolArray, threshold: float) -> NDArray[np.uint8]:
    """Return edge strength on white: grey below the threshold, coloured above."""
    strength = np.maximum(blur_minimum(pixels), 0.0)
    floor = max(threshold, 1e-6)
    below = np.clip(strength / floor, 0, 1)[..., None]
    above = np.clip((strength / floor - 1) / (_FAR_ABOVE - 1), 0, 1)[..., None]
    # an edge pixel begins with half of its colour, so that one sees where the threshold lies
    share = np.where(mask[..., None], 0.5 + 0.5 * above, 0.0)
    soft = 255 - below * (255 - np.array(_SOFT))
    firm = 255 - share * (255 - np.array(_FIRM))
    return np.asarray(np.rint(np.where(mask[..., None], firm, soft)), np.uint8)


def _small(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Reduce a picture to what a page can show."""
    height, width = pixels.shape[:2]
    if width <= MAX_WIDTH_PX:
        return pixels
    size = (MAX_WIDTH_PX, max(1, round(height * MAX_WIDTH_PX / width)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def _jpeg(pixels: NDArray[np.uint8]) -> str:
    _, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return base64_of(encoded.tobytes())


def _corner(values: Any) -> tuple[float | None, ...]:
    x, y, z = (None if value is None else float(value) for value in values)
    return x, y, z


def _view(entry: Mapping[str, Any]) -> ViewPicture:
    width, height = entry["size_px"]
    pictures = [str(entry[f"{name}_jpeg_base64"]) for name in ("grey", "strength")]
    for picture in pictures:
        base64.b64decode(picture, validate=True)
    return ViewPicture(
        camera=str(entry["camera"]),
        source=str(entry["source"]),
        size_px=(int(width), int(height)),
        grey=pictures[0],
        strength=pictures[1],
        threshold=float(entry["threshold"]),
        edge_share=float(entry["edge_share"]),
    )


def _centroid(entry: Mapping[str, Any]) -> dict[str, Any]:
    places = ("seed_px", "match_px", "found_px", "expected_px")
    pairs = {name: [float(value) for value in entry[name]] for name in places}
    if any(len(pair) != 2 for pair in pairs.values()):
        raise ValueError("a centroid has two coordinates")
    return {"point": str(entry["point"]), **pairs}
