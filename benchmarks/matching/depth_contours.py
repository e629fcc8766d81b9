"""Where a depth map is torn, where its surface is curved, and where it has a crease."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

TEAR_MM = 0.5
"""A tear is a step of depth beyond this and beyond twice the slope on both of its sides: a flat
wall seen at grazing incidence has a large but even slope."""

LOOK_PX = 4
"""Pixels inwards from the tear over which the bend is judged."""

BEND = 1.05
"""Least ratio of successive slopes of a curved outline. Next to its outline the depth of a round
body grows with the square root of the distance: slopes fall as 1 : 0.69 : 0.56 : 0.48. A flat face
has even slopes, exactly, since the map has no noise."""

FLAT_MM = 8e-4
"""Second difference of the depth of a plane: 3 times the rounding of a float32 at 1.5 m. A cylinder
of 100 mm radius seen at 3 px per mm has as much."""

CREASE = 3.0
"""A crease's second difference over the mean of the 9 x 9 pixels around: a line one or two pixels
wide has 4.5 to 9, an even bend 1, one made of facets up to 2.5."""

CREASE_MM = 0.05
"""Least second difference of a crease: 10 degrees at 3 px per mm."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthContours:
    """The near side of all tears of a depth map; images of shape (H, W).

    Attributes
    ----------
    near : ndarray of bool
        Pixel lies on the near side of a tear.
    curved : ndarray of bool
        And its surface bends away from the camera there: the outline of a curved body.
    round : ndarray of bool
        Pixel lies on a curved surface, away from any crease: what is seen there (outline,
        highlight, shading) is not bound to a surface point.
    """

    near: BoolArray
    curved: BoolArray
    round: BoolArray

    @classmethod
    def of(cls, depth_mm: FloatArray) -> DepthContours:
        """Find the tears along rows and columns."""
        near = np.zeros(depth_mm.shape, np.bool_)
        even, bent = near.copy(), near.copy()
        for axis in (0, 1):
            for flip in (False, True):
                view = depth_mm if axis else depth_mm.T
                masks = [near, bent, even]
                for mask, found in zip(
                    masks, _one_way(view[:, ::-1] if flip else view), strict=True
                ):
                    there = found[:, ::-1] if flip else found
                    np.logical_or(mask, there if axis else there.T, out=mask)
        return cls(near, bent & ~even, _round(depth_mm, near))


def _one_way(depth: FloatArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return pixels whose left neighbour is torn off and farther; of these the bent, the even."""
    height, width = depth.shape
    inward = np.full((height, width, LOOK_PX + 1), np.nan)  # slopes, from the tear inwards
    slope = np.diff(depth, axis=1)  # slope[:, i] = depth[i + 1] - depth[i]
    for k in range(LOOK_PX + 1):
        inward[:, : width - 1 - k, k] = -slope[:, k:]
    outward = np.zeros_like(depth)  # step to the left neighbour, farther is positive
    outward[:, 1:] = -slope
    beyond = np.zeros_like(depth)
    beyond[:, 2:] = np.abs(slope[:, :-1])
    own = np.abs(np.nan_to_num(inward[..., 0]))
    torn = outward > TEAR_MM + 2 * np.maximum(beyond, own)
    whole = torn.copy()  # no other tear within the pixels looked at
    for k in range(LOOK_PX):
        whole &= np.abs(np.nan_to_num(inward[..., k], nan=np.inf)) < outward
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = inward[..., :-2] / inward[..., 1:-1]
        falls = (ratio > BEND) & (inward[..., 1:-1] > 0)
    bent = whole & falls.all(axis=2)
    return torn, bent, whole & ~bent


def _round(depth: FloatArray, near: BoolArray) -> BoolArray:
    """Mark curved surfaces: bent everywhere around, not along one line."""
    # 1 / z of a plane is linear in pixels, z is not
    inverse = 1 / depth
    second = np.zeros_like(depth)
    for axis in (0, 1):
        along = np.abs(np.diff(inverse, 2, axis=axis))
        pad = [(1, 1) if axis == i else (0, 0) for i in (0, 1)]
        second = np.maximum(second, np.pad(along, pad))
    second *= depth**2
    torn = cv2.dilate(near.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    second[torn] = 0
    bent = ((second > FLAT_MM) | torn).astype(np.uint8)
    bent = cv2.morphologyEx(bent, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))  # facets
    bent = cv2.morphologyEx(bent, cv2.MORPH_OPEN, np.ones((7, 7), np.uint8))  # creases
    known = cv2.blur((~torn).astype(np.float64), (9, 9))
    usual = cv2.blur(second, (9, 9)) / np.maximum(known, 1e-9)
    crease = (second > np.maximum(CREASE * usual, CREASE_MM)).astype(np.uint8)
    crease = cv2.dilate(crease, np.ones((3, 3), np.uint8))
    return np.asarray((bent > 0) & ~((crease > 0) & ~torn))
