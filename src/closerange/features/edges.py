"""Edge points to a fraction of a pixel, with direction, width and uncertainty, linked to chains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from closerange.errors import InputError
from closerange.features.edge_chains import chain_numbers, link_edges
from closerange.features.edge_uncertainty import WIDE, model_std
from closerange.features.grey_noise import WINDOW_PX, noise_curve
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray, frozen_array, frozen_ints
from closerange.geometry.interpolation import bicubic, bilinear

SCALE_PX = 0.8
"""Standard deviation of the Gaussian whose derivative finds edges. An optical image has a blur of
about as much; more would merge the two edges of a thin face, less would let noise through."""

SIGNIFICANCE = 5.0
"""Gradient, in standard deviations of its own noise, from which on a pixel may be an edge: white
noise exceeds it once in 270 000 pixels."""

SHORTEST = 6
"""Points of a chain; shorter ones are noise, or too short to tell a direction."""

MARGIN = 3
"""Pixels along the image border whose neighbourhood is incomplete."""


@dataclass(frozen=True, slots=True, eq=False)
class EdgePoints:
    """Points on the edges of one image; N points.

    Attributes
    ----------
    xy_px : ndarray, shape (N, 2)
        Where the gradient along its own direction is largest.
    normal : ndarray, shape (N, 2)
        Unit vector towards the brighter side.
    strength : ndarray, shape (N,)
        Gradient, grey values per px.
    width_px2 : ndarray, shape (N,)
        Second moment of the gradient's profile: blur of the image and of the operator, and more
        where two edges are so near to each other that they look like one.
    noise_px : ndarray, shape (N,)
        Standard deviation along the normal that the noise of the pixels causes.
    model_px : ndarray, shape (N,)
        Standard deviation along the normal of what the edge is not: an ideal step. Neighbours
        share it; see `closerange.features.edge_uncertainty`.
    after, before : ndarray of int, shape (N,)
        The next and the previous point of the chain, with the brighter side on the left of an
        observer who walks along it with y down; -1 at an end.
    size_px : tuple of int
        Width and height of the image.
    """

    xy_px: FloatArray
    normal: FloatArray
    strength: FloatArray
    width_px2: FloatArray
    noise_px: FloatArray
    model_px: FloatArray
    after: IntArray
    before: IntArray
    size_px: tuple[int, int]

    def __post_init__(self) -> None:
        count = len(self.strength)
        for name in ("xy_px", "normal"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count, 2), name))
        for name in ("strength", "width_px2", "noise_px", "model_px"):
            object.__setattr__(self, name, frozen_array(getattr(self, name), (count,), name))
        for name in ("after", "before"):
            object.__setattr__(self, name, frozen_ints(getattr(self, name), (count,), name))

    def __len__(self) -> int:
        return len(self.strength)

    @property
    def tangent(self) -> FloatArray:
        """Unit vectors along the chain, shape (N, 2): the normal turned from x to y."""
        return np.column_stack([-self.normal[:, 1], self.normal[:, 0]])

    def select(self, rows: ArrayLike) -> EdgePoints:
        """Keep some points and link them anew."""
        chosen = np.asarray(rows)
        # [] has a float's type
        kept = np.arange(len(self))[chosen if chosen.size else slice(0)]
        after, before = link_edges(self.xy_px[kept], self.normal[kept], self.size_px)
        return EdgePoints(
            self.xy_px[kept],
            self.normal[kept],
            self.strength[kept],
            self.width_px2[kept],
            self.noise_px[kept],
            self.model_px[kept],
            after,
            before,
            self.size_px,
        )


def find_edges(
    pixels: NDArray[Any],
    *,
    scale_px: float = SCALE_PX,
    significance: float = SIGNIFICANCE,
    shortest: int = SHORTEST,
) -> EdgePoints:
    """Find edge points to a fraction of a pixel.

    The maxima of the smoothed gradient along its direction (doi:10.1109/TPAMI.1986.4767851),
    placed by a parabola through three bicubic samples of the gradient's magnitude: bilinear samples
    would bias it by 0.06 px with the point's place in the pixel grid, these by 0.01 px.

    Parameters
    ----------
    pixels : ndarray, shape (H, W)
        Grey values, uint8 or uint16.
    scale_px : float, optional
        Standard deviation of the Gaussian.
    significance : float, optional
        Least gradient in standard deviations of its noise.
    shortest : int, optional
        Least number of points of a chain.

    Returns
    -------
    EdgePoints
        In the order of rows and columns; none in an image without edges.

    Raises
    ------
    InputError
        If the image is not grey or smaller than the operator.
    """
    grey = np.asarray(pixels)
    if grey.ndim != 2 or min(grey.shape) < 4 * MARGIN:
        raise InputError(
            f"an image of shape {grey.shape}; edges need grey values, "
            f"{4 * MARGIN} x {4 * MARGIN} pixels or more",
            remedy="convert colour images to grey; use whole images",
        )
    grey = grey.astype(np.float32)
    # what is made of the whole image on the way is gone before the next is made: memory
    every = _significant(grey, scale_px, significance)
    found = every.select(_long(every.after, shortest))
    drift = _drift(grey, found, WIDE * scale_px)
    return replace(found, model_px=model_std(found.strength, found.width_px2, drift, found.after))


def _significant(grey: NDArray[np.float32], scale_px: float, significance: float) -> EdgePoints:
    """Return all edge points that noise does not explain, without the uncertainty of the model."""
    level = cv2.blur(grey, (WINDOW_PX, WINDOW_PX))
    curve = noise_curve(grey, level)
    slope = _gradient(grey, scale_px)
    magnitude = cv2.magnitude(*slope)
    first, second = _noise_gains(scale_px)
    row, column = _maxima(slope, magnitude, significance * first * curve.noise.min())
    noise = curve.at(level[row, column])
    significant = magnitude[row, column] > significance * first * noise
    row, column, noise = row[significant], column[significant], noise[significant]
    normal = np.column_stack([part[row, column] for part in slope]).astype(np.float64)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    xy_px, strength, width = _peak(magnitude, np.column_stack([column, row]), normal)
    # the peak moves by the noise of the second derivative over the curvature of the peak
    noise_px = second * noise * width / strength
    size_px = (grey.shape[1], grey.shape[0])
    chains = link_edges(xy_px, normal, size_px)
    none = np.zeros(len(row))
    return EdgePoints(xy_px, normal, strength, width, noise_px, none, *chains, size_px)


def _gradient(grey: NDArray[np.float32], scale_px: float) -> tuple[NDArray[np.float32], ...]:
    smooth = cv2.GaussianBlur(grey, (0, 0), scale_px, borderType=cv2.BORDER_REPLICATE)
    half = np.array([[-0.5, 0, 0.5]], dtype=np.float32)
    border = cv2.BORDER_REPLICATE
    return (
        np.asarray(cv2.filter2D(smooth, -1, half, borderType=border), dtype=np.float32),
        np.asarray(cv2.filter2D(smooth, -1, half.T.copy(), borderType=border), dtype=np.float32),
    )


def _noise_gains(scale_px: float) -> tuple[float, float]:
    """Return what white noise becomes in the first and in the second derivative."""
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(4 * scale_px)) + 1, scale_px).ravel()
    first = np.convolve(kernel, [0.5, 0.0, -0.5])
    second = np.convolve(first, [0.5, 0.0, -0.5])
    across = np.linalg.norm(kernel)
    return float(np.linalg.norm(first) * across), float(np.linalg.norm(second) * across)


def _maxima(
    slope: tuple[NDArray[np.float32], ...],
    magnitude: NDArray[np.float32],
    floor: float,
) -> tuple[IntArray, IntArray]:
    """Return rows and columns of the pixels whose gradient no neighbour along it exceeds."""
    strong = magnitude > floor
    strong[:MARGIN], strong[-MARGIN:] = False, False
    strong[:, :MARGIN], strong[:, -MARGIN:] = False, False
    row, column = np.nonzero(strong)
    here = magnitude[row, column]
    along = np.column_stack([part[row, column] / here for part in slope])
    centre = np.column_stack([column, row]).astype(np.float32)
    peak = (here >= bilinear(magnitude, centre - along)) & (
        here > bilinear(magnitude, centre + along)
    )
    return row[peak], column[peak]


def _peak(
    magnitude: NDArray[np.float32], pixel: IntArray, normal: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Place the peak of the gradient along its direction; return its height and width too."""
    xy_px = pixel.astype(np.float64)
    # a first step with cheap samples: the second then starts within 0.1 px of the peak
    shift, *_ = _vertex(*(bilinear(magnitude, xy_px + step * normal) for step in (-1, 0, 1)))
    xy_px = xy_px + np.clip(shift, -0.7, 0.7)[:, None] * normal
    below, here, above = (bicubic(magnitude, xy_px + step * normal) for step in (-1, 0, 1))
    shift, curvature = _vertex(below, here, above)
    xy_px = xy_px + np.clip(shift, -0.5, 0.5)[:, None] * normal
    return xy_px, here, here / curvature


def _vertex(
    below: FloatArray, here: FloatArray, above: FloatArray
) -> tuple[FloatArray, FloatArray]:
    curvature = np.maximum(2 * here - below - above, 1e-3 * np.abs(here) + 1e-12)
    return 0.5 * (above - below) / curvature, curvature


def _drift(grey: NDArray[np.float32], edges: EdgePoints, scale_px: float) -> FloatArray:
    """Return how far each edge moves along its normal when it is looked at more coarsely, px."""
    magnitude = cv2.magnitude(*_gradient(grey, scale_px))
    samples = (bicubic(magnitude, edges.xy_px + step * edges.normal) for step in (-1, 0, 1))
    return np.clip(_vertex(*samples)[0], -1.0, 1.0)


def _long(after: IntArray, shortest: int) -> BoolArray:
    """Mark the points of chains of at least so many points."""
    chain = chain_numbers(after)
    return np.asarray(np.bincount(chain, minlength=1)[chain] >= shortest)
