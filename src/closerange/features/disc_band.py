"""The pixels along a disc's edge: which ones, their weights and what they say of noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from closerange.features.disc_model import (
    BLUR,
    LENS_LOG_STD,
    USUAL_LENS_PX,
    blur_px,
    density,
    grey_values,
    outline_of,
)
from closerange.geometry.arrays import BoolArray, FloatArray
from closerange.geometry.ellipse import Ellipse
from closerange.geometry.least_squares import LeastSquaresFit

# Half-width of the fitted band: within 3 sigma of blur the edge is complete to 0.1 % of the
# contrast; 2.5 px more of flat grey on either side fix the two levels and their slopes (within
# 10 % of the bound that all pixels would allow) and stay a small neighbourhood of the edge.
BAND_BLURS, BAND_FLAT_PX = 3.0, 2.5
# A pixel next to another feature is left out where that feature's own blur reaches it.
NEIGHBOUR_BLURS = 2.0
# Foreground this near to a disc's outline is its own edge.
OWN_EDGE_PX = 2.0
# Rounding to whole grey values: uniform over one of them.
QUANTISATION_DN2 = 1 / 12
# Share of the edge profile below which a pixel is flat, and how many flat pixels give a variance
# of their own (to a quarter of its value).
FLAT_SHARE, FLAT_PIXELS = 0.03, 30
IMAGINED_PIXELS = 2
# With more pixels than this the first pass takes every second one.
MANY_PIXELS = 400


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """The surroundings of a disc, wide enough for any band that makes sense."""

    origin: FloatArray
    xy: FloatArray
    values: FloatArray
    to_other: FloatArray

    @classmethod
    def around(cls, pixels: NDArray[Any], start: Ellipse, foreground: BoolArray | None) -> Crop:
        """Cut out the disc and as much again around it, eight pixels at least."""
        a, _, _ = start.axes
        reach = a + max(a, 8.0)
        first = np.maximum(np.floor(start.centre - reach), 0).astype(int)
        last = np.maximum(np.ceil(start.centre + reach) + 1, first).astype(int)
        window = (slice(first[1], last[1]), slice(first[0], last[0]))
        values = pixels[window].astype(np.float64)
        rows, columns = np.indices(values.shape)
        xy = np.stack([columns + first[0], rows + first[1]], axis=-1) - start.centre
        to_other = np.full(values.size, np.inf)
        if foreground is not None:
            own = start.signed_distance(xy + start.centre) < OWN_EDGE_PX
            free = (~foreground[window] | own).astype(np.uint8)
            if not free.all():
                distances = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5)
                to_other = distances.astype(np.float64).ravel()
        return cls(np.asarray(start.centre), xy.reshape(-1, 2), values.ravel(), to_other)

    def band(
        self, x: FloatArray, variances: tuple[float, float] | None, full_scale: float
    ) -> Band | None:
        """Choose the pixels along the edge; None if they cannot carry the parameters."""
        distance = outline_of(x).signed_distance(self.xy)
        blur = blur_px(x)
        at_edge = np.abs(distance) < 1
        gap = float(self.to_other[at_edge].min()) if at_edge.any() else 0.0
        chosen = np.abs(distance) <= BAND_BLURS * blur + BAND_FLAT_PX
        chosen &= self.to_other > min(NEIGHBOUR_BLURS * blur, gap / 2)
        if np.count_nonzero(chosen) <= x.size:
            return None
        clips = bool((self.values[chosen] >= full_scale).any())
        if variances is None and not clips and np.count_nonzero(chosen) > MANY_PIXELS:
            chosen[::2] = False  # enough to place the band and to weigh its two sides
        xy, values, distance = self.xy[chosen], self.values[chosen], distance[chosen]
        inside = ndtr(-distance / blur)
        if variances is None:
            variances = _first_variances(values, inside)
        variance = variances[0] + (variances[1] - variances[0]) * inside
        return Band(xy, values, inside, np.sqrt(variance), full_scale if clips else np.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Pixels of one pass, with the share of the disc in each and their standard deviations."""

    xy: FloatArray
    values: FloatArray
    inside: FloatArray
    std: FloatArray
    full_scale: float

    def levels(self) -> tuple[float, float]:
        """Guess background and contrast from the pixels that are most outside and inside."""
        low, high = np.quantile(self.inside, (0.25, 0.75))
        background = float(np.median(self.values[self.inside <= low]))
        return background, float(np.median(self.values[self.inside >= high])) - background

    def residuals(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Weighted residuals and Jacobian; the last row is the lens' usual blur."""
        model, jacobian = grey_values(x, self.xy)
        if np.isfinite(self.full_scale):
            # E[min(value + noise, full scale)] and its slope
            excess = (model - self.full_scale) / self.std
            unclipped = ndtr(-excess)
            model = model - self.std * (excess * (1 - unclipped) + density(excess))
            jacobian = jacobian * unclipped[:, None]
        rows = np.zeros((x.size, len(model) + 1))
        rows[:, :-1] = jacobian.T / self.std
        rows[BLUR, -1] = 1 / LENS_LOG_STD
        usual = (x[BLUR] - np.log(USUAL_LENS_PX)) / LENS_LOG_STD
        return np.append((model - self.values) / self.std, usual), rows.T

    def counted(self, fit: LeastSquaresFit) -> tuple[BoolArray, float]:
        """Return which pixels tell about noise, and the factor for the fitted parameters."""
        kept = np.ones(len(self.values), dtype=bool)
        if np.isfinite(self.full_scale):
            kept = grey_values(fit.x, self.xy)[0] < self.full_scale - 2 * self.std
        number = int(np.count_nonzero(kept))
        return kept, number / max(number + 1 - fit.x.size, 1)

    def variances_after(self, fit: LeastSquaresFit) -> tuple[float, float]:
        """Grey-value variance outside and inside, from the residuals where the disc is flat."""
        kept, factor = self.counted(fit)
        squares = factor * (fit.residuals[:-1] * self.std) ** 2
        mixed: FloatArray | None = None
        found = []
        for side, flat in enumerate((self.inside < FLAT_SHARE, self.inside > 1 - FLAT_SHARE)):
            chosen = squares[flat & kept]
            if chosen.size >= FLAT_PIXELS:
                found.append(float(chosen.mean()))
                continue
            if mixed is None:
                mixed = self._mixed_variances(squares, kept)
            found.append(float(mixed[side]))
        return max(found[0], QUANTISATION_DN2), max(found[1], QUANTISATION_DN2)

    def _mixed_variances(self, squares: FloatArray, kept: BoolArray) -> FloatArray:
        """Variances outside and inside of a small disc, from all pixels by their share of it."""
        weight = 1 / self.std[kept] ** 2
        shares = np.column_stack([1 - self.inside[kept], self.inside[kept]]) * weight[:, None]
        # A dozen pixels can drive one variance to zero or below; a few imagined pixels of the
        # mean variance on either side keep the weights sane.
        mean = float(squares[kept].mean()) if kept.any() else QUANTISATION_DN2
        imagined = np.sqrt(IMAGINED_PIXELS) / mean
        rows = np.vstack([shares, imagined * np.eye(2)])
        right = np.append(squares[kept] * weight, [imagined * mean] * 2)
        variances = np.linalg.lstsq(rows, right, rcond=None)[0]
        return np.asarray(np.maximum(variances, 0.1 * mean))


def _first_variances(values: FloatArray, inside: FloatArray) -> tuple[float, float]:
    """Robust variances of the flat sides: weights for the first pass only."""
    found = []
    for flat in (inside < FLAT_SHARE, inside > 1 - FLAT_SHARE):
        chosen = values[flat]
        if chosen.size < FLAT_PIXELS:
            continue
        deviation = float(np.median(np.abs(chosen - np.median(chosen))))
        found.append(max((1.4826 * deviation) ** 2, QUANTISATION_DN2))
    return (found[0], found[-1]) if found else (1.0, 1.0)
