"""What a matching method takes and gives, so that all are measured alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from closerange.rig.camera import Camera

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Images = Sequence[NDArray[Any]]


class UnavailableError(Exception):
    """The method cannot run here; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """What a method found for M points; NaN where it found nothing.

    Attributes
    ----------
    xy_px : ndarray, shape (M, 2)
        Place in the second view, before any filter.
    flags : ndarray of int, shape (M,)
        0 for what the method keeps in the end; any other number is a rejection.
    checked : ndarray of bool, shape (M,)
        What passes the left-right check (or the method's own equivalent) alone.
    cov_px2 : ndarray, shape (M, 2, 2), or None
        Covariance in the second view of the surface point that is seen at the given point.
    one_way_s : float
        Time of the search alone, where a left-right check was added to it by this benchmark; NaN
        where the check is the method's own.
    """

    xy_px: FloatArray
    flags: NDArray[np.int64]
    checked: BoolArray
    cov_px2: FloatArray | None = None
    one_way_s: float = float("nan")

    def __len__(self) -> int:
        return len(self.xy_px)


class Method(Protocol):
    """A matching method."""

    name: str

    def match(
        self,
        images: Images,
        cameras: Sequence[Camera],
        points_px: FloatArray,
        volume_mm: FloatArray,
    ) -> Matches:
        """Find points of the first view in the second.

        Parameters
        ----------
        images : sequence of ndarray, shape (H, W), uint8
            The first is that of the points; a third and more may help.
        cameras : sequence of Camera
            In the same order.
        points_px : ndarray, shape (M, 2)
            Where to start from, px of the first view.
        volume_mm : ndarray, shape (2, 3)
            Where the points may be in the world; infinite where there is no limit.

        Raises
        ------
        UnavailableError
            If the method cannot run here.
        """
        ...
