"""A proposed measuring volume with all that speaks for it, beside the one in use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import GeometryError
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.matching.common_view import CommonView, common_view, shared_field
from closerange.matching.view_grid import sees_points
from closerange.matching.volume_proposal import propose_volume
from closerange.rig.camera import Camera
from closerange.rig.rig import Rig

_WALL_NODES = 5
"""Nodes along each side, on the walls too: inside of a box errors are smooth."""

_SHARE_NODES = 21
"""Nodes along each side of the calibrated volume whose share in view is counted: good to 1 %."""


@dataclass(frozen=True, slots=True, eq=False)
class VolumeProposal:
    """What the cameras of a rig see in common, and a measuring volume in it.

    Attributes
    ----------
    cameras : tuple of Camera
        C cameras.
    view : CommonView
        What they see in common.
    volume_mm : ndarray, shape (2, 3)
        The proposal; lower and upper corner.
    std_mm : ndarray, shape (2, 3)
        Smallest and largest standard deviation of X, Y, Z of one position in it, from the image
        noise alone.
    shared : ndarray, shape (C,)
        Share of each camera's image that enough others see too, at the depth of the volume's
        middle.
    calibrated_mm : ndarray, shape (2, 3)
        The rig's measuring volume.
    calibrated_seen : float
        Share of it that enough cameras see; 0 to 1.
    """

    cameras: tuple[Camera, ...]
    view: CommonView
    volume_mm: FloatArray
    std_mm: FloatArray
    shared: FloatArray
    calibrated_mm: FloatArray
    calibrated_seen: float

    def __post_init__(self) -> None:
        shapes = {"volume_mm": (2, 3), "std_mm": (2, 3), "calibrated_mm": (2, 3)}
        for name, shape in (shapes | {"shared": (len(self.cameras),)}).items():
            object.__setattr__(self, name, frozen_array(getattr(self, name), shape, name))


def survey_volume(
    rig: Rig,
    *,
    least: int | None = None,
    margin_px: float = 0.0,
    within_mm: ArrayLike | None = None,
) -> VolumeProposal:
    """Propose a measuring volume for a rig and say what speaks for it.

    Parameters
    ----------
    rig : Rig
        Two or more cameras.
    least : int, optional
        How many cameras must see a place. By default all; as many as share any place where not
        all do.
    margin_px, within_mm
        As in `propose_volume`.

    Returns
    -------
    VolumeProposal
        Nothing hides anything in it: what will stand in the volume is not known.

    Raises
    ------
    InputError
        If there is a single camera, or an option is impossible.
    GeometryError
        If no two cameras see the same place.
    """
    volume, count = _proposed(rig, least, margin_px, within_mm)
    view = common_view(rig, least=count, margin_px=margin_px)
    cell = (volume[1] - volume[0]) / (_WALL_NODES - 1)
    around = np.stack([volume[0] - cell / 2, volume[1] + cell / 2])
    # a margin is kept by the volume; the nodes on its walls may miss it by a rounding error
    inner = common_view(rig, least=count, nodes=_WALL_NODES, within_mm=around)
    std = inner.std_mm[inner.inside]
    return VolumeProposal(
        cameras=rig.cameras,
        view=view,
        volume_mm=volume,
        std_mm=np.stack([std.min(axis=0), std.max(axis=0)]),
        shared=shared_field(rig.cameras, volume.mean(axis=0), least=count),
        calibrated_mm=rig.volume_mm,
        calibrated_seen=_seen_share(rig, count, margin_px),
    )


def _proposed(
    rig: Rig, least: int | None, margin_px: float, within_mm: ArrayLike | None
) -> tuple[FloatArray, int]:
    """Propose with the number of cameras asked for, or with as many as share a place."""
    count = len(rig.cameras) if least is None else least
    while True:
        try:
            volume = propose_volume(rig, least=count, margin_px=margin_px, within_mm=within_mm)
        except GeometryError:
            if least is not None or count <= 2:
                raise
            count -= 1
        else:
            return volume, count


def _seen_share(rig: Rig, least: int, margin_px: float) -> float:
    """Return the share of the rig's volume that enough cameras see."""
    low, high = rig.volume_mm
    share = np.linspace(0.0, 1.0, _SHARE_NODES)
    axes = [low[axis] + share * (high[axis] - low[axis]) for axis in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = np.sum([sees_points(camera, nodes, margin_px) for camera in rig.cameras], axis=0)
    return float((seen >= least).mean())
