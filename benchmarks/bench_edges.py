"""Morphological edge operators against Canny and second-derivative zero crossings.

    python benchmarks/bench_edges.py [--seeds 15] [--output edges.png]

As in sections 1.3 and 4.4 of the thesis: an ideal step (the border between two columns of pixels)
and a real one (a disc, each pixel averaging over its area), under growing noise. All operators get
the same chance: each marks as many pixels as the true edge has, its strongest ones, so no
threshold is tuned. Operators that give bands (the morphological ones, Sobel) are asked for two
pixels per px of edge, thin ones (Canny, zero crossings) for one. "auto" is `edge_mask`, which
chooses its threshold itself.

Figures, medians over the seeds: Pratt's figure of merit (1 = perfect; mean of 1 / (1 + d^2 / 9), d
in px beyond half the band's width, over the larger of marked and wanted numbers); missed =
share of the border without a mark within 1.5 px; false = share of the marks farther than 2 px; off
= mean signed distance of the others from the border, towards the bright side, in px.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from closerange.features.edge_operators import (
    blur_minimum,
    dilation_residue_strength,
    edge_mask,
    erosion_residue_strength,
)

SIZE = 128
CONTRAST = 100.0
NOISES = (0.0, 5.0, 10.0, 20.0, 40.0)
NEAR_PX, FAR_PX = 1.5, 2.0
SCALE = 1.4  # standard deviation of both thin operators' Gaussians, px: a 9 x 9 mask

Array = np.ndarray
Marks = Callable[[Array, int], Array]


def step() -> tuple[Array, Array, float]:
    """Return an ideal step, each pixel's distance from it (positive where bright), its length."""
    distance = np.broadcast_to(np.arange(SIZE) - SIZE / 2 + 0.5, (SIZE, SIZE)).copy()
    return 78 + CONTRAST * (distance > 0), distance, SIZE


def disc() -> tuple[Array, Array, float]:
    """Return the same of an area-sampled disc, blurred by a lens."""
    factor, radius, centre = 8, 41.3, np.array([63.2, 64.7])
    fine = (np.mgrid[0 : SIZE * factor, 0 : SIZE * factor] + 0.5) / factor - 0.5
    inside = np.hypot(*(fine - centre[:, None, None])) < radius
    image = inside.reshape(SIZE, factor, SIZE, factor).mean((1, 3))
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    pixels = np.mgrid[0:SIZE, 0:SIZE] - centre[:, None, None]
    return 78 + CONTRAST * image, radius - np.hypot(*pixels), 2 * np.pi * radius


def strongest(strength: Array, count: int) -> Array:
    """Mark the strongest pixels; where more are equally strong than fit, all of them."""
    limit = np.partition(strength.ravel(), -count)[-count]
    return (strength >= limit) & (strength > 0)


def sobel(image: Array, count: int) -> Array:
    """Enhancement and threshold: gradient magnitude."""
    x, y = (cv2.Sobel(image.astype(np.float32), -1, *order) for order in ((1, 0), (0, 1)))
    return strongest(np.hypot(x, y), count)


def canny(image: Array, count: int) -> Array:
    """Canny's detector; the upper threshold is that which marks about the wanted number."""
    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SCALE)
    # 16-bit derivatives, scaled so that rounding does not matter
    x, y = (
        np.rint(16 * cv2.Sobel(soft, -1, *order)).astype(np.int16) for order in ((1, 0), (0, 1))
    )
    low, high = 1.0, 1.5 * float(np.hypot(x.astype(float), y).max()) + 2

    def above(threshold: float) -> Array:
        return cv2.Canny(x, y, 0.4 * threshold, threshold, L2gradient=True) > 0

    for _ in range(20):
        middle = (low + high) / 2
        marked = np.count_nonzero(above(middle))
        low, high = (middle, high) if marked > count else (low, middle)
    # hysteresis takes whole chains: the number jumps, from all to none on a clean edge
    return min(above(low), above(high), key=lambda marks: abs(np.count_nonzero(marks) - count))


def zero_crossings(image: Array, count: int) -> Array:
    """Laplacian of a Gaussian: the nearer pixel of each change of sign, by its slope."""
    soft = cv2.GaussianBlur(image.astype(np.float64), (0, 0), SCALE)
    second = cv2.Laplacian(soft, cv2.CV_64F)
    # exactly symmetric steps leave rounding of 1e-13 where the Laplacian is 0
    second[np.abs(second) < 1e-9] = 0.0
    slope = np.zeros_like(second)
    for axis in (0, 1):
        here = second[:-1] if axis == 0 else second[:, :-1]
        there = second[1:] if axis == 0 else second[:, 1:]
        crossing = np.where(here * there < 0, np.abs(here - there), 0.0)
        nearer = np.abs(here) <= np.abs(there)
        first, last = (slope[:-1], slope[1:]) if axis == 0 else (slope[:, :-1], slope[:, 1:])
        np.maximum(first, np.where(nearer, crossing, 0), out=first)
        np.maximum(last, np.where(nearer, 0, crossing), out=last)
    return strongest(slope, count)


OPERATORS: dict[str, tuple[Marks, int]] = {
    "erosion residue": (lambda image, n: strongest(erosion_residue_strength(image), n), 2),
    "dilation residue": (lambda image, n: strongest(dilation_residue_strength(image), n), 2),
    "min, no blur": (lambda image, n: strongest(blur_minimum(image, blur_px=1), n), 2),
    "blur-minimum 3": (lambda image, n: strongest(blur_minimum(image), n), 2),
    "blur-minimum 5": (lambda image, n: strongest(blur_minimum(image, blur_px=5), n), 2),
    "blur-min. 3, auto": (lambda image, _: edge_mask(image)[0], 2),
    "Sobel": (sobel, 2),
    "Canny": (canny, 1),
    "zero crossings": (zero_crossings, 1),
}


def figures(
    marks: Array, distance: Array, count: int, width: int
) -> tuple[float, float, float, float]:
    """Return figure of merit, missed share, false share and signed offset."""
    away = np.maximum(np.abs(distance) - width / 2, 0)
    number = int(np.count_nonzero(marks))
    merit = float((1 / (1 + away[marks] ** 2 / 9)).sum() / max(count, number))
    border = np.abs(distance) <= 0.5
    reach = cv2.distanceTransform((~marks).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    missed = float((reach[border] > NEAR_PX).mean()) if number else 1.0
    false = float((np.abs(distance[marks]) > FAR_PX).mean()) if number else np.nan
    near = marks & (np.abs(distance) <= FAR_PX)
    return merit, missed, false, float(distance[near].mean()) if near.any() else np.nan


def noisy(clean: Array, noise: float, seed: int) -> Array:
    """Add noise and round to 8 bits."""
    random = np.random.default_rng(seed).normal(0, noise, clean.shape)
    return np.clip(np.rint(clean + random), 0, 255).astype(np.uint8)


def table(name: str, scene: tuple[Array, Array, float], seeds: int) -> None:
    """Print the figures of one scene."""
    clean, distance, length = scene
    print(f"\n{name}: contrast {CONTRAST:g}, figure of merit | missed % | false % | off px")
    print(f"{'noise':18}" + "".join(f"{noise:>24g}" for noise in NOISES))
    for operator, (marks_of, width) in OPERATORS.items():
        wanted = round(length * width)
        cells = []
        for noise in NOISES:
            rows = []
            for seed in range(seeds if noise else 1):
                marks = marks_of(noisy(clean, noise, seed), wanted)
                rows.append(figures(marks, distance, wanted, width))
            merit, missed, false, off = np.median(rows, axis=0)
            cells.append(f"{merit:8.3f} {100 * missed:4.0f} {100 * false:4.0f} {off:+5.2f}")
        print(f"{operator:18}" + "".join(cells))


def picture(scenes: dict[str, tuple[Array, Array, float]], path: Path) -> None:
    """Draw what each operator marks: a row for each scene and noise, a column for each."""
    rows = []
    for clean, _, length in scenes.values():
        for noise in NOISES:
            image = noisy(clean, noise, 0)
            marks = [f(image, round(length * w)) for f, w in OPERATORS.values()]
            tiles = [image, *(np.where(m, 0, 255).astype(np.uint8) for m in marks)]
            rows.append(np.hstack([np.pad(t, 2, constant_values=128) for t in tiles]))
    cv2.imwrite(str(path), np.vstack(rows))
    print(f"\n{path}: image, then {', '.join(OPERATORS)}; noise {', '.join(map(str, NOISES))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=15)
    parser.add_argument("--output", type=Path, help="Also draw the marks (PNG).")
    options = parser.parse_args()
    scenes = {"ideal step": step(), "disc": disc()}
    for name, scene in scenes.items():
        table(name, scene, options.seeds)
    if options.output:
        picture(scenes, options.output)


if __name__ == "__main__":
    main()
