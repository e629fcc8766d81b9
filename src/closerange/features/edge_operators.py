"""Edge strength by morphology: erosion residue, dilation residue, blur-minimum; edge masks."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from closerange.errors import InputError
from closerange.features.morphology import dilation_residue, erosion_residue
from closerange.features.structuring import StructuringElement
from closerange.features.threshold import ThresholdReport, edge_threshold

ROD = StructuringElement.of_points([(0, -1), (0, 1), (-1, 0), (1, 0)])
"""The thesis' flat rod of radius 1 (Fig. 4.2): the four neighbours, without the centre.

Its tables cannot show that: with the centre, every operator here gives max(0, strength). Without
it, a pixel that differs from all its neighbours has a strength of its own sign, which is negative
for a peak in the dilation residue and for a pit in the erosion residue."""

BLUR_PX = 3
"""Side of the square whose mean is the blur of equation 4.9. The thesis does not name its blur;
3 is the smallest that turns the step between two pixels into a ramp of two equal halves, which is
what makes the minimum of both residues large on both sides of an edge."""

_NOISE_SAMPLE = 2**17  # pixels that a median is taken of: it is then good to half a per cent


def erosion_residue_strength(
    image: NDArray[Any], element: StructuringElement = ROD
) -> NDArray[Any]:
    """Return the edge strength G_e(r, c) = max over (i, j) of f(r, c) - f(r + i, c + j).

    Equation 4.7. It lies on the bright side of an edge and answers to isolated bright pixels.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Grey image; see `closerange.features.morphology.erode`.
    element : StructuringElement, optional
        The thesis' rod by default.

    Returns
    -------
    ndarray, shape (H, W)
        Signed grey levels; what is not above 0 is no edge.

    Raises
    ------
    InputError
        If the image has another form.
    """
    return erosion_residue(_grey(image), element)


def dilation_residue_strength(
    image: NDArray[Any], element: StructuringElement = ROD
) -> NDArray[Any]:
    """Return the edge strength G_d(r, c) = max over (i, j) of f(r - i, c - j) - f(r, c).

    Equation 4.8. It lies on the dark side of an edge and answers to isolated dark pixels.

    Parameters
    ----------
    image, element
        As for `erosion_residue_strength`.

    Returns
    -------
    ndarray, shape (H, W)
        Signed grey levels; what is not above 0 is no edge.

    Raises
    ------
    InputError
        If the image has another form.
    """
    return dilation_residue(_grey(image), element)


def blur_minimum(
    image: NDArray[Any], element: StructuringElement = ROD, *, blur_px: int = BLUR_PX
) -> NDArray[Any]:
    """Return the edge strength min(I1 - erosion(I1), dilation(I1) - I1), I1 the blurred image.

    Equation 4.9, after Lee, Haralick and Shapiro, IEEE Journal of Robotics and Automation RA-3
    (1987) 142-156. An isolated pixel is brighter or darker than its surroundings but not between
    them: one of the residues is small, and the minimum with it. On an ideal step the blur makes
    pixels that are between.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Grey image.
    element : StructuringElement, optional
        The thesis' rod by default.
    blur_px : int, optional
        Side of the square that is averaged, odd; 1 for no blur. Beyond the image its border
        pixels are repeated.

    Returns
    -------
    ndarray, shape (H, W)
        float32 (float64 for a float64 image), not rounded: an 8-bit blur would throw away what
        averaging gained. Grey levels; negative only where a pixel of the blurred image exceeds
        or falls below all pixels of the element, which is no edge.

    Raises
    ------
    InputError
        If the image has another form, or the blur's side is even or too large.
    """
    grey = _grey(image)
    if blur_px % 2 == 0 or not 1 <= blur_px <= 255:
        raise InputError(
            f"the blur's side is {blur_px} px", remedy="choose an odd number from 1 to 255"
        )
    depth = np.float64 if grey.dtype == np.float64 else np.float32
    blurred = cv2.blur(
        np.ascontiguousarray(grey, dtype=depth),
        (blur_px, blur_px),
        borderType=cv2.BORDER_REPLICATE,
    ).reshape(grey.shape)
    strength = np.minimum(erosion_residue(blurred, element), dilation_residue(blurred, element))
    return np.asarray(strength, dtype=depth)


def pixel_noise(image: NDArray[Any]) -> float:
    """Estimate the standard deviation of the noise of single pixels from one grey image.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Grey image; its border pixels are repeated beyond it.

    Returns
    -------
    float
        In grey levels. 1.4826 times the median of |image * M| / 6, M being the second
        difference in both directions, [1 -2 1] x [1 -2 1] (doi:10.1006/cviu.1996.0060). Slopes,
        straight edges along rows or columns and, being the minority, all other edges and
        textures do not enter. For whole grey values at least 0.29, the noise of rounding.

    Raises
    ------
    InputError
        If the image has another form.
    """
    grey = _grey(image)
    ones = np.array([1.0, -2.0, 1.0])
    differences = cv2.sepFilter2D(
        grey.astype(np.float32), -1, ones, ones, borderType=cv2.BORDER_REPLICATE
    )
    sample = np.abs(differences.ravel()[:: 1 + differences.size // _NOISE_SAMPLE])
    sigma = 1.4826 * float(np.median(sample)) / 6
    return sigma if grey.dtype.kind == "f" else max(sigma, float(np.sqrt(1 / 12)))


def edge_mask(image: NDArray[Any]) -> tuple[NDArray[np.bool_], ThresholdReport]:
    """Mark the edge pixels of an image: blur-minimum strength above Trussell's threshold.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Grey image.

    Returns
    -------
    mask : ndarray of bool, shape (H, W)
        Edge pixels, bands of two or three px; thinning is another step.
    report : ThresholdReport
        The threshold and all its alternatives; see
        `closerange.features.threshold.edge_threshold`.

    Raises
    ------
    InputError
        If the image has another form.
    """
    strength = blur_minimum(image)
    report = edge_threshold(strength, noise=pixel_noise(image))
    return np.asarray(strength > report.threshold), report


def _grey(image: NDArray[Any]) -> NDArray[Any]:
    """Refuse what is not a grey image; the rest is checked where it is eroded."""
    if image.ndim != 2 or image.size == 0 or image.dtype == bool:
        raise InputError(
            f"an image of {image.dtype} and shape {image.shape} has no edge strength",
            remedy="give a two-dimensional grey image",
        )
    return image
