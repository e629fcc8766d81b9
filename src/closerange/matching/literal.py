"""The thesis' matcher, literally: erosion of the neighbourhood by a structuring element.

Chapter 5, sections 5.2 to 5.6: the edge pixels of N x N px around a point of image 1 are carried
into view 2 through the plane farthest from the cameras and scanned over the epipolar segment; the
place at which the fewest of them are missing from the edges of image 2 is the correspondence. A
reference for comparison: `closerange.matching` has better matchers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError
from closerange.features.edge_operators import edge_mask
from closerange.features.threshold import threshold_report
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, all_finite
from closerange.matching.literal_band import Bands, bands
from closerange.matching.literal_element import (
    EdgePixels,
    MappedElements,
    check_side,
    farthest_plane,
    footprint,
)
from closerange.matching.literal_matches import LiteralMatches, join_matches
from closerange.matching.literal_scan import Chosen, Hits, PackedImage, choose_places
from closerange.matching.sight import checked_volume, inside_image, sight_line
from closerange.rig.camera import Camera

Progress = Callable[[int, int], None]

BAND_PX = 0.5
"""Half-width of the band: the whole pixels nearest to the segment. The thesis draws a line."""

_PIECE = 8192
"""Points whose places are listed at once: 60 MB for segments of 500 px."""


def binary_images(
    images: Sequence[NDArray[Any]], *, original: bool = False
) -> tuple[BoolArray, BoolArray]:
    """Threshold both images as section 5.3 does.

    Parameters
    ----------
    images : sequence of two ndarrays, shape (H, W)
        Grey images.
    original : bool, optional
        Threshold the images themselves, for objects that stand out from their background;
        otherwise their blur-minimum edge strength.

    Returns
    -------
    tuple of two ndarrays of bool, shape (H, W)
        Pixels above Trussell's threshold (equation 5.1); none in a blank image.

    Raises
    ------
    InputError
        If an image has another form.
    """
    first, second = images
    if original:
        masks = (np.asarray(grey > threshold_report(grey).threshold) for grey in (first, second))
    else:
        masks = (edge_mask(grey)[0] for grey in (first, second))
    one, two = masks
    return one, two


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Points and where they are looked for, whatever the element; M points.

    Attributes
    ----------
    seed_px : ndarray, shape (M, 2)
        Points of view 1; NaN for one that is none.
    pixel : ndarray of int, shape (M, 2)
        The nearest pixel, around which elements are cut.
    centre_px : ndarray, shape (M, 2)
        Where the plane of the elements puts each point in view 2; NaN where nowhere.
    places : Bands
        Neighbourhoods.
    """

    seed_px: FloatArray
    pixel: IntArray
    centre_px: FloatArray
    places: Bands

    def select(self, rows: NDArray[np.intp]) -> Search:
        """Keep some points, in the given order."""
        places = Bands(*(getattr(self.places, field.name)[rows] for field in fields(Bands)))
        return Search(self.seed_px[rows], self.pixel[rows], self.centre_px[rows], places)


class LiteralMatcher:
    """The literal matcher for one pair of images, for any number of points and elements.

    Parameters
    ----------
    cameras : sequence of two Cameras
        View 1, whose points are given, and view 2.
    masks : sequence of two ndarrays of bool, shape (H, W)
        See `binary_images`.
    volume_mm : array_like, shape (2, 3)
        Where the points may be in the world; see
        `closerange.matching.search.between_planes`.
    band_px : float, optional
        Half-width of the band around the segment; see `closerange.matching.literal_band.bands`.

    Raises
    ------
    InputError
        If an image has another size than its camera, or the volume or the band is none.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        masks: Sequence[BoolArray],
        volume_mm: ArrayLike,
        *,
        band_px: float = BAND_PX,
    ) -> None:
        first, second = cameras
        for camera, mask in zip((first, second), masks, strict=True):
            _check_size(camera, mask)
        self.cameras = (first, second)
        self.volume_mm = checked_volume(volume_mm)
        self.band_px = band_px
        self._image = PackedImage(np.asarray(masks[1], np.bool_))
        plane = farthest_plane(first, second, self.volume_mm)
        self._edges = EdgePixels(first, second, np.asarray(masks[0], np.bool_), plane)

    def match(
        self,
        xy_px: ArrayLike,
        inside: BoolArray,
        *,
        whole_image: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> LiteralMatches:
        """Match points of view 1.

        Parameters
        ----------
        xy_px : array_like, shape (N, 2)
            Points; the element is cut around the nearest pixel.
        inside : ndarray of bool, shape (S, S)
            Footprint of the element; see `closerange.matching.literal_element.footprint`.
        whole_image : bool, optional
            Scan the whole image 2 instead of the segment, for comparison: it takes a thousand
            times as long.
        progress : callable, optional
            Called with the number of points done and of all.

        Returns
        -------
        LiteralMatches
            N points.

        Raises
        ------
        InputError
            If the element is larger than image 1.
        """
        seeds = np.reshape(np.asarray(xy_px, np.float64), (-1, 2))
        seeds = np.where(np.isfinite(seeds), seeds, np.nan)
        step = 1 if whole_image else _PIECE
        found = []
        for first in range(0, len(seeds), step):
            piece = seeds[first : first + step]
            search = self.search(piece, whole_image=whole_image)
            elements = self.elements(search, inside)
            if whole_image:
                hits = self._image.scan_all(elements, 0).reshape(1, -1)
            else:
                hits = self.scan(elements, search.places)
            chosen = choose_places(hits, search.places)
            found.append(self.decided(search, elements, len(inside), chosen))
            if progress is not None:
                progress(first + len(piece), len(seeds))
        return join_matches(found)

    def search(self, seeds: FloatArray, *, whole_image: bool = False) -> Search:
        """Find the neighbourhoods of points.

        Parameters
        ----------
        seeds : ndarray, shape (M, 2)
            Points; NaN for one that is none.
        whole_image : bool, optional
            The whole image 2 instead of the band around the segment.

        Returns
        -------
        Search
            For elements of any kind.
        """
        first, second = self.cameras
        rays = sight_line(first, seeds, self.volume_mm)
        there = inside_image(first, seeds)
        last = np.array(first.size_px) - 1
        pixel = np.clip(np.rint(np.where(there[:, None], seeds, 0.0)), 0, last)
        return Search(
            seed_px=seeds,
            pixel=pixel.astype(np.int64),
            centre_px=self._edges.carried(np.where(there[:, None], rays.direction, np.nan)),
            places=_everywhere(second, there) if whole_image else bands(second, rays, self.band_px),
        )

    def elements(self, search: Search, inside: BoolArray) -> MappedElements:
        """Cut the elements around points and carry them into view 2.

        Parameters
        ----------
        search : Search
            Of M points; an element is empty where there is no point in the image.
        inside : ndarray of bool, shape (S, S)
            Footprint.

        Returns
        -------
        MappedElements
            M elements.

        Raises
        ------
        InputError
            If the element is larger than image 1.
        """
        _check_footprint(self.cameras[0], inside)
        return self._edges.elements(search.pixel, search.centre_px, inside)

    def scan(self, elements: MappedElements, places: Bands) -> Hits:
        """Count the pixels of elements that are present at each place; see `PackedImage.scan`."""
        return self._image.scan(elements, places)

    def decided(
        self, search: Search, elements: MappedElements, side_px: int, chosen: Chosen
    ) -> LiteralMatches:
        """Turn chosen places into matches with their flags.

        Parameters
        ----------
        search : Search
            Of M points.
        elements : MappedElements
            Of `elements`.
        side_px : int
            Their N.
        chosen : Chosen
            Of `choose_places` after `scan`.

        Returns
        -------
        LiteralMatches
            M points.
        """
        seeds, places = search.seed_px, search.places
        flags = places.flags.copy()
        there = inside_image(self.cameras[0], seeds)
        known = all_finite(seeds, 1)
        flags[~known] = int(Flag.not_found)
        flags[(known & ~there) | elements.oversized] |= int(Flag.outside_image)
        barred = flags & ~int(Flag.near_parallel) != 0
        flags[~barred & (chosen.hits == 0)] |= int(Flag.no_edge)
        found = ~barred & (chosen.hits > 0)
        rows = np.arange(len(seeds))
        at = np.column_stack([places.column[rows, chosen.place], places.row[rows, chosen.place]])
        flags[found & chosen.spread] |= int(Flag.ambiguous)
        cut = _cut(self.cameras[0], np.rint(seeds), side_px // 2) | _sticks_out(
            self.cameras[1], at, elements
        )
        flags[found & cut] |= int(Flag.at_border)
        return LiteralMatches(
            seed_px=seeds,
            xy_px=np.where(found[:, None], at, np.nan),
            mismatch=np.where(found, elements.pixels - chosen.hits, np.nan),
            pixels=elements.pixels,
            ties=np.where(found, chosen.ties, 0),
            flags=flags,
        )


def _check_size(camera: Camera, mask: BoolArray) -> None:
    width, height = camera.size_px
    if mask.shape != (height, width):
        found = "x".join(str(side) for side in mask.shape[::-1])
        raise InputError(
            f"the image of camera {camera.name!r} has {found} px, the camera {width}x{height}",
            remedy="give whole images of the size that was calibrated",
        )


def _check_footprint(camera: Camera, inside: BoolArray) -> None:
    if inside.ndim != 2 or inside.shape[0] != inside.shape[1] or not inside.any():
        raise InputError(
            f"an element of shape {inside.shape} with {np.count_nonzero(inside)} px",
            remedy="give a square array with some pixels set",
        )
    check_side(len(inside))
    if len(inside) > min(camera.size_px):
        raise InputError(
            f"an element of {len(inside)} px in an image of {min(camera.size_px)} px",
            remedy="choose an element smaller than the parts",
        )


def _everywhere(camera: Camera, usable: BoolArray) -> Bands:
    """Return the whole image as the neighbourhood, row by row."""
    width, height = camera.size_px
    shape = (len(usable), width * height)
    place = np.arange(width * height, dtype=np.int32)
    return Bands(
        column=np.broadcast_to(place % width, shape),
        row=np.broadcast_to(place // width, shape),
        valid=np.broadcast_to(usable[:, None], shape),
        flags=np.zeros(len(usable), np.int64),
    )


def _cut(camera: Camera, centre_px: FloatArray, reach: int) -> BoolArray:
    """Tell which elements reach beyond the border of image 1."""
    last = np.array(camera.size_px) - 1
    with np.errstate(invalid="ignore"):
        return np.asarray(((centre_px < reach) | (centre_px > last - reach)).any(axis=1))


def _sticks_out(camera: Camera, at: NDArray[np.int32], elements: MappedElements) -> BoolArray:
    """Tell which elements, at their places, have pixels beyond the border of image 2."""
    last = np.array(camera.size_px) - 1
    lowest, highest = elements.lowest[:, ::-1] + at, elements.highest[:, ::-1] + at
    return np.asarray(((lowest < 0) | (highest > last)).any(axis=1))


def match_literal(
    images: Sequence[NDArray[Any]],
    cameras: Sequence[Camera],
    xy_px: ArrayLike,
    volume_mm: ArrayLike,
    *,
    side_px: int = 15,
    band_px: float = BAND_PX,
    original: bool = False,
    whole_image: bool = False,
) -> LiteralMatches:
    """Match points as chapter 5 of the thesis does, with its square element.

    Parameters
    ----------
    images : sequence of two ndarrays, shape (H, W)
        Grey images of view 1 and view 2.
    cameras : sequence of two Cameras
        In the same order.
    xy_px : array_like, shape (N, 2)
        Points of view 1.
    volume_mm : array_like, shape (2, 3)
        Where they may be; `closerange.matching.search.between_planes` gives the thesis' volume.
    side_px : int, optional
        N, odd: 15 for edge points, 59 for centroids in the thesis' images of 512 px, 150 mm.
    band_px : float, optional
        Half-width of the neighbourhood around the epipolar segment, 0.5 or more.
    original : bool, optional
        Threshold the images, not their edge strength; see `binary_images`.
    whole_image : bool, optional
        The whole image 2 as neighbourhood; see `LiteralMatcher.match`.

    Returns
    -------
    LiteralMatches
        N points.

    Raises
    ------
    InputError
        If an image has another size than its camera, or the element, the band or the volume is
        none.
    """
    for camera, image in zip(cameras, images, strict=True):
        _check_size(camera, image)
    check_side(side_px, largest_px=min(cameras[0].size_px))
    inside = footprint(side_px)
    masks = binary_images(images, original=original)
    matcher = LiteralMatcher(cameras, masks, volume_mm, band_px=band_px)
    return matcher.match(xy_px, inside, whole_image=whole_image)
