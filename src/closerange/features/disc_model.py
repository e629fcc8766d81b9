"""Grey values of a blurred ellipse on an uneven background, and their derivatives."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from closerange.geometry.arrays import FloatArray
from closerange.geometry.ellipse import Ellipse, axes_of_shape, distance_terms

# A pixel is a square, not a point: of all edges it takes this variance.
PIXEL_BLUR_PX2 = 1 / 12
# Blur of a lens in focus, and how far it may be off: a factor 2 is one sigma. A thousand pixels
# overrule it; on a disc of a dozen pixels, where blur, size and contrast are exchangeable, it
# decides.
USUAL_LENS_PX, LENS_LOG_STD = 0.75, float(np.log(2.0))
# Below this radius (blurs) the interior has no flat middle that could show a slope of its own.
SLOPE_RADIUS_BLURS = 6.0
# A blur beyond 0.02 .. 50 px is not what this model describes.
LARGEST_LOG_BLUR = 4.0

# Parameters: centre x, y and shape xx, xy, yy as in `distance_terms`; logarithm of the lens' blur;
# background with two slopes; contrast with two slopes. Positions count from the start's centre.
BLUR, BACKGROUND, CONTRAST, CONTRAST_SLOPES = 5, 6, 9, 10


def start_vector(start: Ellipse) -> FloatArray:
    """Return all parameters for an outline; the grey levels are still 0."""
    (xx, xy), (_, yy) = start.shape
    return np.array([0, 0, xx, xy, yy, np.log(USUAL_LENS_PX), 0, 0, 0, 0, 0, 0], dtype=np.float64)


def outline_of(x: FloatArray) -> Ellipse:
    """Return the outline, its centre counted from the start's."""
    return Ellipse(x[:2], np.array([[x[2], x[3]], [x[3], x[4]]]))


def grey_values(x: FloatArray, xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return grey values (n,) and their Jacobian (n, p); NaN outside the model's domain."""
    if not abs(x[BLUR]) < LARGEST_LOG_BLUR:
        return np.full(len(xy), np.nan), np.full((len(xy), x.size), np.nan)
    distance, by_centre, by_shape, _ = distance_terms(x[:5], xy)
    blur = blur_px(x)
    t = distance / blur
    inside = ndtr(-t)
    slopes = xy.T
    background = x[BACKGROUND] + x[BACKGROUND + 1 : CONTRAST] @ slopes
    contrast = np.full(len(xy), x[CONTRAST])
    if x.size > CONTRAST_SLOPES:
        contrast += x[CONTRAST_SLOPES:] @ slopes
    edge = contrast * density(t)
    by_distance = edge / -blur
    rows = np.empty((x.size, len(xy)))  # one parameter a row is quicker to fill
    rows[:2] = by_distance * by_centre.T
    rows[2:BLUR] = by_distance * by_shape.T
    rows[BLUR] = edge * t * (1 - PIXEL_BLUR_PX2 / blur**2)
    rows[BACKGROUND] = 1
    rows[BACKGROUND + 1 : CONTRAST] = slopes
    rows[CONTRAST] = inside
    rows[CONTRAST_SLOPES:] = inside * slopes[: x.size - CONTRAST_SLOPES]
    return background + contrast * inside, rows.T


def blur_px(x: FloatArray) -> float:
    """Return the blur of lens and pixel together."""
    return float(np.sqrt(np.exp(2 * x[BLUR]) + PIXEL_BLUR_PX2))


def has_flat_middle(x: FloatArray) -> bool:
    """Return whether the disc is large enough to show slopes of its contrast."""
    blur = max(blur_px(x), USUAL_LENS_PX)
    return axes_of_shape(*x[2:5])[1] > SLOPE_RADIUS_BLURS * blur


def density(t: FloatArray) -> FloatArray:
    """Return the normal density."""
    return np.asarray(np.exp(-0.5 * t * t) / np.sqrt(2 * np.pi))
