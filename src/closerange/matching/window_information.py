"""How large a structuring element must be: information along the epipolar curve against noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.features.grey_noise import WINDOW_PX, noise_curve
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.geometry.interpolation import bilinear

HALF_WIDTHS = (5, 7, 10, 14, 20, 28, 40)
"""Half-widths, px, from which one is chosen for each point: the area doubles from one to the next.
Fewer than 11 x 11 px leave nothing to judge the fit of five parameters by."""

WIDEST_SHARE = 1 / 16
"""Half-width of the largest window per image width, where that is more than 40 px: a camera of
twice the resolution shows a part twice as large, and its windows may be so too."""

SIGMA_SHARE = 0.5
"""Standard deviation of the Gaussian weights per half-width: at the rim a seventh is left."""

ENOUGH_SHARE = 0.003
"""Standard deviation along the epipolar curve, per px of half-width, that is asked of the
information. Interpolation leaves 0.01 to 0.03 px in windows of ten; curvature of the surface and
what lies on another one grow with the window, and noise need not be less than they are."""

CORE_SHARE = 0.125
"""Share of a window's information that the half as wide window must hold: evenly spread texture
has a quarter there. Less means a plain surface whose border comes into view."""


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Structure of an image at several scales and at N points.

    Attributes
    ----------
    tensor : ndarray, shape (S, N, 3)
        Sums over windows of the products of derivatives xx, xy, yy in units of the noise of the
        grey values, px^-2; what the noise itself contributes is taken off.
    """

    tensor: FloatArray

    @classmethod
    def of(
        cls, grey: NDArray[np.float32], xy_px: FloatArray, half_widths: tuple[int, ...]
    ) -> Information:
        """Measure around points.

        Parameters
        ----------
        grey : ndarray of float32, shape (H, W)
            Image.
        xy_px : ndarray, shape (N, 2)
            Points.
        half_widths : tuple of int
            S half-widths of windows with Gaussian weights, px.
        """
        noise = noise_map(grey)
        slope = [
            cv2.Sobel(grey, cv2.CV_32F, *order, ksize=3, scale=1 / 8) / noise
            for order in ((1, 0), (0, 1))
        ]
        # of white noise with unit variance, Sobel's derivative keeps 12 / 64
        own = 12 / 64
        products = (slope[0] ** 2 - own, slope[0] * slope[1], slope[1] ** 2 - own)
        tensor = np.empty((len(half_widths), len(xy_px), 3))
        for part, product in enumerate(products):
            for number, half_width in enumerate(half_widths):
                tensor[number, :, part] = _window_sum(product, xy_px, SIGMA_SHARE * half_width)
        return cls(tensor)

    def select(self, rows: slice | BoolArray) -> Information:
        """Keep some points."""
        return Information(self.tensor[:, rows])

    def along(self, direction: FloatArray) -> FloatArray:
        """Return the information about a shift along directions in the image, shape (S, N).

        The inverse of its root is the standard deviation, px, if nothing else is unknown.

        Parameters
        ----------
        direction : ndarray, shape (N, 2)
            Shift per px of what is asked for.
        """
        x, y = direction.T
        xx, xy, yy = np.moveaxis(self.tensor, 2, 0)
        return np.asarray(np.maximum(x * x * xx + 2 * x * y * xy + y * y * yy, 0.0))


def half_widths(width_px: int) -> tuple[int, ...]:
    """Return the half-widths from which one is chosen in images so wide, px."""
    widths = list(HALF_WIDTHS)
    while widths[-2] * 2 <= WIDEST_SHARE * width_px:
        widths.append(widths[-2] * 2)
    return tuple(widths)


def noise_map(grey: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the standard deviation of the noise of every pixel, shape (H, W)."""
    level = cv2.blur(grey, (WINDOW_PX, WINDOW_PX))
    return noise_curve(grey, level).at(level).astype(np.float32)


def chosen_sizes(
    information: FloatArray, half_widths: tuple[int, ...], enough_px: float | None = None
) -> IntArray:
    """Choose the size of the structuring element of each point.

    The smallest that holds enough information along the epipolar curve: noise falls with the size
    of a window, while what its surface is not, a plane, grows with it, and where the two are equal
    their sum is least. The information must not come from the rim alone (`CORE_SHARE`), else the
    window has only just met the border of a plain surface.

    Parameters
    ----------
    information : ndarray, shape (S, N)
        About the match along the epipolar curve, both images together.
    half_widths : tuple of int
        S half-widths, ascending.
    enough_px : float, optional
        Standard deviation that the information must allow, instead of `ENOUGH_SHARE`.

    Returns
    -------
    ndarray of int, shape (N,)
        Number of the size; -1 where none holds enough texture.
    """
    limit = ENOUGH_SHARE * np.array(half_widths, np.float64)[:, None]
    if enough_px is not None:
        limit = np.full_like(limit, enough_px)
    enough = information >= limit**-2
    core = np.ones_like(enough)
    for number, half_width in enumerate(half_widths):
        inner = [k for k in range(number) if half_widths[k] <= half_width // 2]
        if inner:
            core[number] = information[inner[-1]] >= CORE_SHARE * information[number]
    good = enough & core
    return np.where(good.any(axis=0), good.argmax(axis=0), -1)


def _window_sum(product: NDArray[Any], xy_px: FloatArray, sigma: float) -> FloatArray:
    """Sum under a Gaussian around each point; in a smaller image where the Gaussian is wide."""
    step = max(int(sigma // 2), 1)
    height, width = product.shape
    if step > 1:
        size = (max(width // step, 2), max(height // step, 2))
        product = cv2.resize(product, size, interpolation=cv2.INTER_AREA)
    ratio = np.array([product.shape[1] / width, product.shape[0] / height])
    mean = cv2.GaussianBlur(
        product, (0, 0), sigma * ratio[0], sigmaY=sigma * ratio[1], borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(2 * np.pi * sigma**2 * bilinear(mean, (xy_px + 0.5) * ratio - 0.5))
