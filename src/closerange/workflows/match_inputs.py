"""What the verb `match` is given, checked before anything is sought: images, points, volume."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from closerange.errors import InputError
from closerange.features.image_points import ImagePoints
from closerange.features.points_table import read_points
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.images import Frame, check_duplicates, check_interlace, read_image
from closerange.matching.correspondences import Correspondences
from closerange.matching.literal_element import check_side
from closerange.matching.sight import between_planes, checked_volume
from closerange.matching.volume_proposal import propose_volume
from closerange.rig.rig import Rig

Images = Mapping[str, str | Path | Frame]
Points = ImagePoints | Correspondences | Path | str
Origin = Literal["stated", "rig", "proposed"]
Method = Literal["default", "literal"]
METHODS = ("default", "literal")

LITERAL_PX = 15
"""Side of the literal method's element, as in the thesis' example 1."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Wanted:
    """What is to be matched, where and how; the options of `closerange.match`, checked.

    Raises
    ------
    InputError
        If options contradict each other.
    """

    points: Points | None = None
    edges: bool = False
    corners: bool = False
    z_mm: tuple[float, float] | None = None
    volume_mm: ArrayLike | None = None
    placement: str | None = None
    method: Method = "default"
    element_px: int | None = None

    def __post_init__(self) -> None:
        kinds = {"points": self.points is not None, "edges": self.edges, "corners": self.corners}
        given = [name for name, on in kinds.items() if on]
        if len(given) > 1:
            raise InputError(
                f"{' and '.join(given)} were asked for at once", remedy="match one kind at a time"
            )
        if self.method not in METHODS:
            raise InputError(f"method {self.method!r}", remedy=f"choose {' or '.join(METHODS)}")
        if self.corners and self.literal:
            raise InputError(
                "corners with the literal method, which matches points or edges",
                remedy="choose the default method, or give the corners as points",
            )
        if self.element_px is not None and not self.literal:
            raise InputError(
                f"an element of {self.element_px} px with the default method, which chooses its "
                "own",
                remedy="leave it out, or choose the literal method",
            )
        if self.element_px is not None:
            check_side(self.element_px)

    @property
    def literal(self) -> bool:
        """Whether the thesis' method is asked for."""
        return self.method == "literal"


def read_frames(rig: Rig, images: Images) -> dict[str, Frame]:
    """Read one image of each camera and check it.

    Parameters
    ----------
    rig : Rig
        Gives cameras and sizes.
    images : mapping of str to path or Frame
        By camera.

    Returns
    -------
    dict of str to Frame
        In the order given.

    Raises
    ------
    InputError
        If there are fewer than two, a camera is not in the rig, an image has another size than
        its camera or one image is given for two cameras.

    Warns
    -----
    CloseRangeWarning
        If an image is interlaced.
    """
    if len(rig.cameras) < 2:
        raise InputError(
            f"the rig has a single camera, {rig.cameras[0].name!r}; a match needs two",
            remedy="calibrate both cameras together: closerange calibrate LEFT.csv RIGHT.csv ...",
        )
    if len(images) < 2:
        raise InputError(
            f"{len(images)} image: a match needs two views of different cameras",
            remedy="give one image of each camera, NAME=IMAGE NAME=IMAGE",
        )
    frames: dict[str, Frame] = {}
    for name, image in images.items():
        camera = rig.camera(name)
        frame = image if isinstance(image, Frame) else read_image(image, camera=name)
        if frame.camera not in ("", name):
            raise InputError(
                f"the image given for camera {name!r} says that it is of camera {frame.camera!r}",
                remedy="give each camera its own image",
            )
        if frame.size_px != camera.size_px:
            raise InputError(_wrong_size(rig, name, frame), remedy=(
                "use images of the calibrated size, or calibrate with images of this one"
            ))  # fmt: skip
        frames[name] = Frame(name, frame.pixels, frame.time_s, frame.source)
    check_duplicates(frames.values())
    for frame in frames.values():
        check_interlace(frame)
    return frames


def _wrong_size(rig: Rig, name: str, frame: Frame) -> str:
    sizes = [f"{width}x{height}" for width, height in (frame.size_px, rig.camera(name).size_px)]
    fits = [other.name for other in rig.cameras if other.size_px == frame.size_px]
    hint = f"; it would fit camera {', '.join(map(repr, fits))}" if fits else ""
    where = f"{frame.source}: " if frame.source else ""
    return f"{where}image of {sizes[0]} px; camera {name!r} was calibrated with {sizes[1]} px{hint}"


def read_seeds(points: Points, cameras: Mapping[str, object], placement: str | None) -> ImagePoints:
    """Return the points for which matches are sought: rows of one camera and one placement.

    Parameters
    ----------
    points : ImagePoints, Correspondences or path
        Rows of one camera; of `Correspondences` the first camera's, its seeds.
    cameras : mapping
        Names of the cameras that have an image.
    placement : str, optional
        Keep the rows of this placement only.

    Returns
    -------
    ImagePoints
        At least one row, all of one camera, placement and reading; what has no position and no
        flag is flagged `not_found`.

    Raises
    ------
    InputError
        If the rows are of several cameras, placements or readings, of a camera without an image,
        or there are none.
    """
    where = f"{points}: " if isinstance(points, (str, Path)) else ""
    table = _as_points(points)
    if placement is not None:
        table = table.select(np.array([name == placement for name in table.placement], np.bool_))
    if not len(table):
        of_placement = "" if placement is None else f" of placement {placement!r}"
        raise InputError(f"{where}no points{of_placement}", remedy="give at least one point")
    if len(table.cameras) > 1:
        raise InputError(
            f"{where}points of {len(table.cameras)} cameras ({', '.join(table.cameras)}); matches "
            "are sought for the points of one",
            remedy="keep the rows of one camera; points that all cameras have can be measured",
        )
    camera = table.cameras[0]
    if camera not in cameras:
        raise InputError(
            f"{where}points of camera {camera!r}; the images are of {', '.join(cameras)}",
            remedy=f"give {camera}=IMAGE too, or points of another camera",
        )
    _require_one_state(table, where)
    lost = ~table.found & (table.flags == 0)
    return replace(table, flags=np.where(lost, int(Flag.not_found), table.flags))


def _as_points(points: Points) -> ImagePoints:
    if isinstance(points, ImagePoints):
        return points
    if isinstance(points, Correspondences):
        rows = points.to_image_points()
        return rows.of_camera(points.cameras[0]) if points.cameras else rows
    return read_points(points)


def _require_one_state(table: ImagePoints, where: str) -> None:
    """Refuse points of several states of the world: the images show one."""
    for what, names in (("placements", table.placement), ("readings", table.reading)):
        distinct = list(dict.fromkeys(names))
        if len(distinct) > 1:
            some = ", ".join(
                [*(repr(name) for name in distinct[:3]), *["..."][: len(distinct) > 3]]
            )
            choice = ", with --placement" if what == "placements" else ""
            raise InputError(
                f"{where}points of {len(distinct)} {what} ({some}); the images show one state",
                remedy=f"match the points of one state with its images{choice}",
            )


def volume_of(
    rig: Rig,
    cameras: Iterable[str],
    *,
    z_mm: tuple[float, float] | None = None,
    volume_mm: ArrayLike | None = None,
) -> tuple[FloatArray, Origin]:
    """Return where points may be: the rig's volume unless another one is given.

    Parameters
    ----------
    rig : Rig
        Its measuring volume is the default. Where that is flat, as of control points in one
        plane, no part could stand in it: a proposal of `propose_volume` takes its place.
    cameras : iterable of str
        Names of the cameras that have an image.
    z_mm : (float, float), optional
        Replaces the volume in Z and lifts its limits in X and Y.
    volume_mm : array_like, shape (2, 3), optional
        Replaces the volume; lower and upper corner.

    Returns
    -------
    volume_mm : ndarray, shape (2, 3)
        In mm, infinite where there is no limit.
    origin : {"stated", "rig", "proposed"}
        Whose it is.

    Raises
    ------
    InputError
        If both are given, or limits are not in order.
    GeometryError
        If a volume must be proposed, and the cameras see nothing in common.
    """
    if z_mm is not None and volume_mm is not None:
        raise InputError(
            "both --z and --volume were given", remedy="give one: --z lifts the limits in X and Y"
        )
    if z_mm is not None:
        return between_planes(*z_mm), "stated"
    if volume_mm is not None:
        corners = np.asarray(volume_mm, np.float64)
        return checked_volume(corners.reshape(2, 3) if corners.size == 6 else corners), "stated"
    if (rig.volume_mm[0] < rig.volume_mm[1]).all():
        return rig.volume_mm, "rig"
    return propose_volume([rig.camera(name) for name in cameras], least=2), "proposed"
