"""Outlines of discs for the contour methods: Otsu's threshold and `cv2.findContours`.

N. Otsu, 1979, doi:10.1109/TSMC.1979.4310076; S. Suzuki, K. Abe, 1985,
doi:10.1016/0734-189X(85)90016-7. A contour is a disc if it is round and neither tiny nor huge.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

MIN_PIXELS = 100
ROUND = 0.8  # 4 pi area / length^2; 1 for a circle, 0.785 for a square


def contours(image: NDArray[Any], *, bright: bool) -> list[NDArray[np.int32]]:
    """Return the outlines of round regions, each (n, 1, 2)."""
    kind = cv2.THRESH_BINARY if bright else cv2.THRESH_BINARY_INV
    mask = cv2.threshold(image, 0, 255, kind | cv2.THRESH_OTSU)[1]
    found = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    chosen = []
    for outline in found:
        area, length = cv2.contourArea(outline), cv2.arcLength(outline, closed=True)
        if MIN_PIXELS < area < image.size / 4 and 4 * np.pi * area / length**2 > ROUND:
            chosen.append(outline)
    return chosen
