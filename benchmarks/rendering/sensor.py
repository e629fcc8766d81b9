"""From a fine linear pinhole picture to the 8-bit image of a lens and a sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from rendering.cameras import FloatArray, View

MARGIN_PX = 4.0
"""Rendered beyond the image's ideal outline: five sigma of the PSF and the spline's reach."""

BAND_ROWS = 128  # of the final image at a time: the fine grid of 5 Mpx would fill the memory


@dataclass(frozen=True, slots=True)
class Sensor:
    """What turns light into numbers.

    Attributes
    ----------
    gamma : float
        ``DN = black + f ** (1 / gamma) * (255 - black)``.
    psf_sigma_px, full_well_e, read_noise_e, black_level_dn : float
        Gaussian blur; electrons at full scale; their noise on reading; grey value of no light.
    """

    gamma: float = 1.0
    psf_sigma_px: float = 0.7
    full_well_e: float = 12000.0
    read_noise_e: float = 14.0
    black_level_dn: float = 6.0

    def numbers(self, fraction: FloatArray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """Return grey values of exposures given as fractions of full scale."""
        electrons = np.clip(fraction, 0, 4) * self.full_well_e
        noisy = rng.poisson(electrons) + rng.normal(0, self.read_noise_e, electrons.shape)
        light = np.clip(noisy / self.full_well_e, 0, None) ** (1 / self.gamma)
        grey = self.black_level_dn + light * (255 - self.black_level_dn)
        return np.clip(np.rint(grey), 0, 255).astype(np.uint8)

    def linear(self, image: NDArray[np.uint8]) -> FloatArray:
        """Return grey values as they were without gamma."""
        share = np.clip((image - self.black_level_dn) / (255 - self.black_level_dn), 0, None)
        return np.asarray(self.black_level_dn + share**self.gamma * (255 - self.black_level_dn))


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A picture without distortion, its pixels finer than the camera's.

    Attributes
    ----------
    size : tuple of int
        Columns and rows.
    focal : float
        In fine pixels.
    principal : tuple of float
        Column and row in fine pixels; the centre of the first is (0, 0).
    """

    size: tuple[int, int]
    focal: float
    principal: tuple[float, float]

    @classmethod
    def covering(cls, view: View, fineness: int) -> Pinhole:
        """Return the picture that covers all that a camera sees."""
        width, height = view.size_px
        across, down = np.arange(-1, width + 1), np.arange(-1, height + 1)
        border = [np.column_stack([across, np.full(len(across), row)]) for row in (-1, height)]
        border += [np.column_stack([np.full(len(down), col), down]) for col in (-1, width)]
        ideal = view.ideal(np.concatenate(border).astype(np.float64)) * view.focal_px
        low = np.floor(ideal.min(axis=0) - MARGIN_PX).astype(int)
        high = np.ceil(ideal.max(axis=0) + MARGIN_PX).astype(int)
        columns, rows = (high - low) * fineness
        # low is the outer border of the first fine pixel
        u, v = -low * fineness - 0.5
        return cls((int(columns), int(rows)), view.focal_px * fineness, (float(u), float(v)))


def irradiance(
    picture: NDArray[np.float32],
    pinhole: Pinhole,
    view: View,
    fineness: int,
    psf_sigma_px: float,
) -> FloatArray:
    """Distort, blur and integrate a fine picture.

    Parameters
    ----------
    picture : ndarray, shape (rows, columns), float32
        Linear, as `pinhole` says.
    pinhole : Pinhole
        Geometry of the picture.
    view : View
        Camera to imitate.
    fineness : int
        Fine pixels per pixel.
    psf_sigma_px : float
        Gaussian blur in pixels of the camera.

    Returns
    -------
    ndarray, shape (height, width)
        Mean light of each pixel.
    """
    width, height = view.size_px
    smooth = spline_filter(picture, order=3, output=np.float32)
    bands = []
    for top in range(0, height, BAND_ROWS):
        rows = min(BAND_ROWS, height - top)

        def light(xy_px: FloatArray) -> FloatArray:
            place = view.ideal(xy_px) * pinhole.focal + pinhole.principal
            return np.asarray(
                map_coordinates(smooth, place[:, ::-1].T, order=3, prefilter=False, mode="nearest"),
                np.float64,
            )

        bands.append(_integrated(light, (width, top, rows), fineness, psf_sigma_px))
    return np.concatenate(bands)


def _integrated(
    light: Callable[[FloatArray], FloatArray],
    band: tuple[int, int, int],
    fineness: int,
    psf_sigma_px: float,
) -> FloatArray:
    """Sample a band (width, first row, rows) on the fine grid, blur it, and average to pixels."""
    width, top, rows = band
    pad = int(np.ceil(5 * psf_sigma_px))
    u = (np.arange(-pad * fineness, (width + pad) * fineness) + 0.5) / fineness - 0.5
    v = (np.arange((top - pad) * fineness, (top + rows + pad) * fineness) + 0.5) / fineness - 0.5
    grid = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    fine = light(grid).reshape(len(v), len(u))
    fine = gaussian_filter(fine, psf_sigma_px * fineness, truncate=5)
    fine = fine[pad * fineness : -pad * fineness, pad * fineness : -pad * fineness]
    return np.asarray(fine.reshape(rows, fineness, width, fineness).mean(axis=(1, 3)))
