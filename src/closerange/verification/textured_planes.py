"""Images of textured planes, with exact truth: what matching is tried on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import map_coordinates, spline_filter

from closerange.geometry.arrays import FloatArray, IntArray
from closerange.rig.camera import Camera

OVERSAMPLING = 3
"""Rays per pixel in x and in y."""

TILE = 512
"""Texture elements after which a texture is repeated."""


@dataclass(frozen=True, slots=True, eq=False)
class TexturedPlane:
    """A rectangle in space with a random texture.

    Attributes
    ----------
    centre_mm : ndarray, shape (3,)
        Middle.
    along, across : ndarray, shape (3,)
        Vectors from the middle to the middles of two sides, mm; perpendicular to each other.
    grain_mm : float
        Size of a texture element: the standard deviation of the Gaussian blobs it is made of.
    grey : float
        Mean grey value.
    contrast : float
        Standard deviation of the grey value; 0 is a plain surface.
    seed : int
        Of the texture.
    """

    centre_mm: FloatArray
    along: FloatArray
    across: FloatArray
    grain_mm: float
    grey: float
    contrast: float
    seed: int

    def meets(self, centre_mm: FloatArray, ray: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return distances along rays, infinite where they miss, and the grey values there."""
        normal = np.cross(self.along, self.across)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.centre_mm - centre_mm) @ normal / (ray @ normal)
        place = centre_mm + distance[:, None] * ray - self.centre_mm
        sides = [vector / (vector @ vector) for vector in (self.along, self.across)]
        u, v = (place @ side for side in sides)
        hit = (np.abs(u) <= 1) & (np.abs(v) <= 1) & (distance > 0)
        grey = np.full(len(ray), float(self.grey))
        if self.contrast:
            grain = [np.linalg.norm(vector) / self.grain_mm for vector in (self.along, self.across)]
            coordinates = np.stack([v[hit] * grain[1], u[hit] * grain[0]]) % TILE
            grey[hit] += self.contrast * map_coordinates(
                self._texture(), coordinates, order=3, mode="grid-wrap", prefilter=False
            )
        return np.where(hit, distance, np.inf), grey

    def _texture(self) -> FloatArray:
        """Return spline coefficients of Gaussian noise of unit variance, one element in size."""
        noise = np.random.default_rng(self.seed).normal(size=(TILE, TILE))
        spectrum = np.fft.rfft2(noise)
        frequency = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE))
        smooth = np.fft.irfft2(spectrum * np.exp(-2 * (np.pi * frequency) ** 2), s=(TILE, TILE))
        return np.asarray(spline_filter(smooth / smooth.std(), 3, mode="grid-wrap"))


def render_planes(
    camera: Camera,
    planes: list[TexturedPlane],
    *,
    blur_px: float = 0.7,
    gain: float = 1.0,
    offset: float = 0.0,
    noise: float = 0.0,
    seed: int = 0,
) -> FloatArray:
    """Take a picture of planes.

    Parameters
    ----------
    camera : Camera
        Any lens.
    planes : list of TexturedPlane
        The nearer one hides the other; where there is none it is black.
    blur_px : float, optional
        Standard deviation of the lens' blur.
    gain, offset : float, optional
        Of the camera, applied to the grey values.
    noise : float, optional
        Standard deviation of the noise of a pixel, grey values.
    seed : int, optional
        Of the noise.

    Returns
    -------
    ndarray, shape (H, W)
        Whole grey values from 0 to 255.
    """
    width, height = camera.size_px
    fine = (np.arange(width * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    low = (np.arange(height * OVERSAMPLING) + 0.5) / OVERSAMPLING - 0.5
    pixels = np.stack(np.meshgrid(fine, low), axis=-1).reshape(-1, 2)
    grey, _ = _cast(camera, planes, pixels)
    picture = grey.reshape(len(low), len(fine)) * gain + offset
    picture = cv2.GaussianBlur(picture, (0, 0), blur_px * OVERSAMPLING)
    picture = picture.reshape(height, OVERSAMPLING, width, OVERSAMPLING).mean(axis=(1, 3))
    picture = picture + np.random.default_rng(seed).normal(0.0, 1.0, picture.shape) * noise
    return np.asarray(np.clip(np.rint(picture), 0, 255))


def seen_points(
    camera: Camera, planes: list[TexturedPlane], xy_px: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Return what is seen at pixels.

    Parameters
    ----------
    camera : Camera
        Any lens.
    planes : list of TexturedPlane
        The scene.
    xy_px : ndarray, shape (N, 2)
        Pixels.

    Returns
    -------
    xyz_mm : ndarray, shape (N, 3)
        World points; NaN where there is nothing.
    plane : ndarray of int, shape (N,)
        Number of the plane; -1 where there is none.
    """
    ray = camera.directions(xy_px)
    distance = np.stack([plane.meets(camera.centre_mm, ray)[0] for plane in planes])
    nearest = distance.min(axis=0)
    hit = np.isfinite(nearest)
    xyz = camera.centre_mm + np.where(hit, nearest, np.nan)[:, None] * ray
    return xyz, np.where(hit, distance.argmin(axis=0), -1)


def visible(camera: Camera, planes: list[TexturedPlane], xyz_mm: FloatArray) -> IntArray:
    """Return which points no plane hides from a camera, shape (N,) of bool; frame ignored."""
    ray = xyz_mm - camera.centre_mm
    length = np.linalg.norm(ray, axis=1)
    ray = ray / length[:, None]
    nearest = np.min([plane.meets(camera.centre_mm, ray)[0] for plane in planes], axis=0)
    return np.asarray(nearest > length * (1 - 1e-6))


def _cast(
    camera: Camera, planes: list[TexturedPlane], xy_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    ray = camera.directions(xy_px)
    nearest = np.full(len(ray), np.inf)
    grey = np.zeros(len(ray))
    for plane in planes:
        distance, value = plane.meets(camera.centre_mm, ray)
        front = distance < nearest
        nearest[front], grey[front] = distance[front], value[front]
    return grey, nearest
