"""The verbs `shapes teach` and `shapes find`: taught shapes become image points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from closerange.errors import CloseRangeError, DetectionError, InputError
from closerange.features import shape_recognition, shape_teaching
from closerange.features.image_points import ImagePoints
from closerange.features.shape_recognition import ShapeHit
from closerange.features.shapes import MARGIN_PX, Polarity, Shape
from closerange.features.shapes_file import read_shapes
from closerange.flags import Flag
from closerange.images import Frame, distinct, list_images, placement_and_reading, read_image

Progress = Callable[[int, int], None]
Images = str | Path | Frame | Sequence[str | Path | Frame]

__all__ = ["find_shapes", "teach_shape"]


def teach_shape(
    image: str | Path | Frame,
    *,
    name: str,
    at_px: tuple[float, float],
    polarity: Polarity | None = None,
    margin_px: float = MARGIN_PX,
    rotation_step_deg: float | None = None,
) -> Shape:
    """Teach a shape from a place in an image.

    Parameters
    ----------
    image : path or Frame
        Grey image on which the part lies free.
    name : str
        Name of the shape.
    at_px : (float, float)
        x, y of a place on it.
    polarity, margin_px, rotation_step_deg
        As in `closerange.features.shape_teaching.teach_shape`.

    Returns
    -------
    Shape
        To be written with `closerange.features.shapes_file.write_shapes`.

    Raises
    ------
    InputError
        If the image or an argument cannot be used.
    DetectionError
        If no region stands out there.

    Warns
    -----
    CloseRangeWarning
        If the shape is weak or the steps between its rolls are coarse.
    """
    frame = image if isinstance(image, Frame) else read_image(image)
    try:
        return shape_teaching.teach_shape(
            frame.pixels,
            name=name,
            at_px=at_px,
            polarity=polarity,
            margin_px=margin_px,
            rotation_step_deg=rotation_step_deg,
        )
    except DetectionError as error:
        where = f"{frame.source}: " if frame.source else ""
        raise DetectionError(f"{where}{error.message}", remedy=error.remedy) from error


def find_shapes(
    images: Images,
    *,
    shapes: Sequence[Shape] | Path | str,
    camera: str,
    placement: str | None = None,
    placement_pattern: str | None = None,
    progress: Progress | None = None,
) -> ImagePoints:
    """Find taught shapes in the images of one camera.

    Parameters
    ----------
    images : path, folder, Frame or sequence of these
        Several images are several placements.
    shapes : sequence of Shape or path
        What to look for; a file of `shapes teach`.
    camera : str
        Name of the camera.
    placement : str, optional
        Name of the placement; with one image only. By default each image is a placement named
        by its file's stem.
    placement_pattern : str, optional
        As for `closerange.workflows.detect.detect`.
    progress : callable, optional
        Called with (done, total) after each image.

    Returns
    -------
    ImagePoints
        One row for each find. A shape found once is named by the shape. Found several times it
        is named ``shape-camera-1``, ``-2``, ... from top to bottom: which of them is which in
        another camera is not known here, and rows of one name would be taken for one point. A
        shape not found is a row without position, flagged `not_found`.

    Raises
    ------
    InputError
        If an image, the shapes or the pattern cannot be used, or one exposure occurs twice.
    """
    taught = read_shapes(shapes) if isinstance(shapes, (str, Path)) else tuple(shapes)
    if not taught:
        raise InputError("no shape was given", remedy="teach at least one")
    sources = _sources(images)
    if placement is not None and len(sources) > 1:
        raise InputError(
            f"one placement name for {len(sources)} images",
            remedy="use --placement-pattern, or name one image",
        )
    frames = (
        source if isinstance(source, Frame) else read_image(source, camera=camera)
        for source in sources
    )
    found: ImagePoints | None = None
    for done, frame in enumerate(distinct(frames), start=1):
        name = (
            (placement, "")
            if placement is not None
            else placement_and_reading(Path(frame.source), placement_pattern)
        )
        hits = shape_recognition.find_shapes(frame.pixels, taught)
        points = _as_points(hits, taught, frame, camera, name)
        found = points if found is None else _joined(found, points, frame)
        if progress:
            progress(done, len(sources))
    if found is None:
        raise InputError("no image was named", remedy="name at least one image or folder")
    return found


def _sources(images: Images) -> list[Path | Frame]:
    listed = [images] if isinstance(images, (str, Path, Frame)) else images
    sources: list[Path | Frame] = []
    for image in listed:
        sources.extend([image] if isinstance(image, Frame) else list_images(Path(image)))
    return sources


def _as_points(
    hits: Sequence[ShapeHit],
    shapes: Sequence[Shape],
    frame: Frame,
    camera: str,
    name: tuple[str, str],
) -> ImagePoints:
    """Make rows of hits, in the order of the shapes; shapes without a hit get a row too."""
    points: list[str] = []
    rows: list[ShapeHit | None] = []
    for shape in shapes:
        own = [hit for hit in hits if hit.shape == shape.name]
        many = len(own) > 1
        points += [f"{shape.name}-{camera}-{i}" for i in range(1, len(own) + 1)] if many else [
            shape.name
        ]  # fmt: skip
        rows += own or [None]
    blank, unknown = np.full(2, np.nan), np.full((2, 2), np.nan)
    return ImagePoints.of(
        camera=camera,
        placement=name[0],
        reading=name[1],
        point=points,
        xy_px=[blank if hit is None else hit.xy_px for hit in rows],
        cov_px2=[unknown if hit is None else hit.cov_px2 for hit in rows],
        flags=[int(Flag.not_found if hit is None else hit.flags) for hit in rows],
        size_px={camera: frame.size_px},
    )


def _joined(found: ImagePoints, points: ImagePoints, frame: Frame) -> ImagePoints:
    try:
        return found + points
    except CloseRangeError as error:
        raise InputError(f"{frame.source}: {error.message}", remedy=error.remedy) from error
