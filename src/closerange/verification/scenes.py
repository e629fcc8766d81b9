"""Synthetic scenes: rigs, control points and observations whose truth is known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.features.control import ControlPoints
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray, frozen_array
from closerange.geometry.transform import RigidTransform
from closerange.rig.camera import Camera
from closerange.rig.distortion import BrownIdeal, Distortion
from closerange.rig.rig import Residuals, Rig

GRIDS = {
    18: (3, 3, 2),
    27: (3, 3, 3),
    54: (3, 3, 6),
    63: (3, 3, 7),
    125: (5, 5, 5),
    343: (7, 7, 7),
    2000: (10, 10, 20),
}
"""Columns, rows and planes of the grids that have a customary number of points."""

SIZE_PX = (1280, 1024)
CUBE_MM = 150.0
NOISE_PX = 0.05
KNOWN = 10**9
"""Degrees of freedom of a noise that is not estimated but known."""


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticRig:
    """Cameras with true parameters.

    Attributes
    ----------
    name : str
        For tables.
    cameras : tuple of Camera
        The truth.
    volume_mm : ndarray, shape (2, 3)
        Measuring volume: lower and upper corner.
    noise_px : float
        Standard deviation of one image coordinate.
    """

    name: str
    cameras: tuple[Camera, ...]
    volume_mm: FloatArray
    noise_px: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "volume_mm", frozen_array(self.volume_mm, (2, 3), "volume_mm"))

    def true_rig(self) -> Rig:
        """Return a rig without any calibration error: no free parameters, known noise."""
        nothing = Residuals(
            camera=(),
            placement=(),
            point=(),
            xyz_mm=np.empty((0, 3)),
            xy_px=np.empty((0, 2)),
            residual_px=np.empty((0, 2)),
            fitted=np.empty(0, np.bool_),
            flags=np.empty(0, np.int64),
        )
        return Rig(
            cameras=self.cameras,
            volume_mm=self.volume_mm,
            parameters=(),
            parameter_cov=np.empty((0, 0)),
            noise_px=self.noise_px,
            dof=KNOWN,
            model="exact",
            residuals=nothing,
        )


def looking_at_origin(
    name: str,
    *,
    angle_rad: float,
    distance_mm: float,
    focal_px: float,
    centre_offset_px: Sequence[float] = (0.0, 0.0),
    distortion: Distortion | None = None,
    size_px: tuple[int, int] = SIZE_PX,
) -> Camera:
    """Place a camera in the XZ plane of the world, looking at the origin, world Y upwards.

    Parameters
    ----------
    name : str
        As in the tables.
    angle_rad : float
        From the Z axis towards the X axis.
    distance_mm : float
        From the origin to the projection centre.
    focal_px : float
        fx = fy.
    centre_offset_px : sequence of float, optional
        Principal point relative to the middle of the image.
    distortion : Distortion, optional
        Lens; none without it.
    size_px : tuple of int, optional
        Image width and height.

    Returns
    -------
    Camera
        With z forward, x right, y down.
    """
    forward = -np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)])
    down = np.array([0.0, -1.0, 0.0])
    rotation = np.stack([np.cross(down, forward), down, forward])
    middle = (np.array(size_px) - 1) / 2 + np.asarray(centre_offset_px)
    return Camera(
        name,
        size_px,
        np.array([[focal_px, 0, middle[0]], [0, focal_px, middle[1]], [0, 0, 1]]),
        RigidTransform(rotation, np.array([0.0, 0.0, distance_mm])),
        distortion or BrownIdeal(),
    )


def rig_a() -> SyntheticRig:
    """Make a long-lens rig: 1.5 m away, f = 4800 px, at most 0.5 px of distortion."""
    lens = BrownIdeal(k1=-0.15, k2=0.05, p1=0.001, p2=-0.0005)
    return _pair("A", distance_mm=1500.0, focal_px=4800.0, offset_px=(9.0, 7.0), lens=lens)


def rig_b() -> SyntheticRig:
    """Make a short-lens rig: 0.35 m away, f = 1300 px, up to 12 px of distortion."""
    lens = BrownIdeal(k1=-0.15, k2=0.05, p1=0.001, p2=-0.0005)
    return _pair("B", distance_mm=350.0, focal_px=1300.0, offset_px=(9.0, 7.0), lens=lens)


def strong_lens_rig(*, distance_mm: float = 225.0) -> SyntheticRig:
    """Make a wide-angle rig: f = 800 px, k1 = -0.35, principal point 60 px off the middle.

    Parameters
    ----------
    distance_mm : float, optional
        At 225 mm the cube's corners are displaced by 87 px, at 350 mm by 18 px.

    Returns
    -------
    SyntheticRig
        Two cameras.
    """
    lens = BrownIdeal(k1=-0.35)
    return _pair(
        "strong lens", distance_mm=distance_mm, focal_px=800.0, offset_px=(36.0, 48.0), lens=lens
    )


def control_grid(
    shape: int | Sequence[int], size_mm: float | Sequence[float] = CUBE_MM
) -> ControlPoints:
    """Make exact control points on a box grid centred on the origin.

    Parameters
    ----------
    shape : int or sequence of int
        Number of points along X, Y, Z, or one of the total counts in `GRIDS`.
    size_mm : float or sequence of float, optional
        Length of the box along each axis.

    Returns
    -------
    ControlPoints
        Named ``x{i}y{j}z{k}``, from 0, X running fastest.

    Raises
    ------
    InputError
        If a count has no grid of its own.
    """
    if isinstance(shape, int):
        if shape not in GRIDS:
            raise InputError(
                f"{shape} points: there is no customary grid of this count",
                remedy=f"give the numbers along X, Y, Z, or one of {', '.join(map(str, GRIDS))}",
            )
        shape = GRIDS[shape]
    size = np.broadcast_to(np.asarray(size_mm, np.float64), (3,))
    x, y, z = (
        np.linspace(-half, half, count) if count > 1 else np.zeros(count)
        for half, count in zip(size / 2, shape, strict=True)
    )
    cells = [(i, j, k) for k in range(len(z)) for j in range(len(y)) for i in range(len(x))]
    return ControlPoints.of(
        [f"x{i}y{j}z{k}" for i, j, k in cells],
        np.array([(x[i], y[j], z[k]) for i, j, k in cells]).reshape(-1, 3),
    )


def random_positions(
    count: int, volume_mm: ArrayLike, rng: np.random.Generator, *, prefix: str = "p"
) -> ControlPoints:
    """Draw exact positions, uniform in a volume.

    Parameters
    ----------
    count : int
        How many.
    volume_mm : array_like, shape (2, 3)
        Lower and upper corner.
    rng : numpy.random.Generator
        Source of randomness.
    prefix : str, optional
        Of the names, which go on with a number from 1.

    Returns
    -------
    ControlPoints
        `count` rows, for every placement.
    """
    lower, upper = np.asarray(volume_mm, np.float64)
    width = len(str(count))
    names = [f"{prefix}{i:0{width}d}" for i in range(1, count + 1)]
    return ControlPoints.of(names, rng.uniform(lower, upper, (count, 3)))


def observe(
    cameras: Sequence[Camera],
    control: ControlPoints,
    *,
    noise_px: float,
    rng: np.random.Generator,
    readings: int = 1,
) -> ImagePoints:
    """See points with cameras, with independent normal noise on each image coordinate.

    Parameters
    ----------
    cameras : sequence of Camera
        The truth.
    control : ControlPoints
        True positions; each row is seen once a reading in its placement.
    noise_px : float
        Standard deviation of one coordinate.
    rng : numpy.random.Generator
        Source of randomness.
    readings : int, optional
        Repeated observations of each point, named from 1; a single one has a blank name.

    Returns
    -------
    ImagePoints
        Covariances unknown, as from an ordinary detector. A point outside of an image, or
        behind a camera, is NaN and flagged `not_found`.
    """
    count = len(control)
    columns: dict[str, Any] = {"camera": [], "placement": [], "point": [], "reading": []}
    seen = []
    for camera in cameras:
        exact = camera.project(control.xyz_mm)
        last = np.array(camera.size_px) - 1
        exact[~((exact >= 0) & (exact <= last)).all(axis=1)] = np.nan
        for number in range(1, readings + 1):
            seen.append(exact + noise_px * rng.standard_normal((count, 2)))
            columns["camera"] += [camera.name] * count
            columns["placement"] += control.placement
            columns["point"] += control.point
            columns["reading"] += [str(number) if readings > 1 else ""] * count
    xy = np.concatenate(seen)
    return ImagePoints.of(
        **columns,
        xy_px=xy,
        flags=np.where(np.isfinite(xy).all(axis=1), 0, int(Flag.not_found)),
        size_px={camera.name: camera.size_px for camera in cameras},
    )


def _pair(
    name: str, *, distance_mm: float, focal_px: float, offset_px: Sequence[float], lens: Distortion
) -> SyntheticRig:
    """Make two cameras that converge by 40 degrees on a cube at the origin."""
    left, right = (
        looking_at_origin(
            camera,
            angle_rad=np.radians(angle),
            distance_mm=distance_mm,
            focal_px=focal_px,
            centre_offset_px=offset_px,
            distortion=lens,
        )
        for camera, angle in (("left", -20.0), ("right", 20.0))
    )
    half = CUBE_MM / 2
    volume = np.array([[-half] * 3, [half] * 3])
    return SyntheticRig(name, (left, right), volume, NOISE_PX)
