"""One grey image as it came from a camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A grey image, its camera and its moment.

    Attributes
    ----------
    camera : str
        Name of the camera.
    pixels : ndarray, shape (H, W), uint8 or uint16
        Grey values as recorded, `[row, col]`. Not copied; treat as read-only.
    time_s : float or None
        Moment of exposure in seconds, if known.
    source : str
        Where it came from, for messages and reports (usually a file).

    Raises
    ------
    ValueError
        If the array is not two-dimensional or of another type.
    """

    camera: str
    pixels: NDArray[Any]
    time_s: float | None = None
    source: str = ""

    def __post_init__(self) -> None:
        if self.pixels.ndim != 2 or self.pixels.dtype not in (np.uint8, np.uint16):
            raise ValueError(
                f"pixels are {self.pixels.dtype} of shape {self.pixels.shape}; "
                "expected uint8 or uint16 of shape (H, W)"
            )

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.pixels.shape
        return int(width), int(height)

    @property
    def full_scale(self) -> int:
        """Largest value that the pixel type can hold."""
        return int(np.iinfo(self.pixels.dtype).max)
