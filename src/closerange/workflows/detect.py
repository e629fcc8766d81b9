"""The verb `detect`: images of a target become image points."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from closerange.errors import CloseRangeError, CloseRangeWarning, DetectionError, InputError
from closerange.features.detect import detect_target
from closerange.features.image_points import ImagePoints
from closerange.features.target import Chessboard, Target
from closerange.features.target_file import read_target
from closerange.files import read_csv
from closerange.images import (
    Frame,
    check_frame,
    distinct,
    list_images,
    placement_and_reading,
    read_image,
)

Progress = Callable[[int, int], None]
Images = str | Path | Frame | Sequence[str | Path | Frame]

__all__ = ["Images", "Progress", "detect", "read_crops"]


def detect(
    images: Images,
    *,
    target: Target | Path | str,
    camera: str,
    placement: str | None = None,
    placement_pattern: str | None = None,
    estimator: str = "least-squares",
    crops: Mapping[str, tuple[float, float]] | Path | str | None = None,
    progress: Progress | None = None,
) -> ImagePoints:
    """Find a target in the images of one camera.

    Parameters
    ----------
    images : path, folder, Frame or sequence of these
        Several images are several placements.
    target : Target or path
        What to look for; a TOML file or a `Target`.
    camera : str
        Name of the camera that took the images.
    placement : str, optional
        Name of the placement; with one image only. By default each image is a placement named
        by its file's stem.
    placement_pattern : str, optional
        Regular expression searched in the stem: group 1 names the placement, a group named
        ``reading`` the repeated reading.
    estimator : str, optional
        ``least-squares`` or ``border-centroid`` (the thesis' eq. 2.7).
    crops : mapping or path, optional
        For images cut out of larger ones: full-image px of each crop's pixel (0, 0), by file
        name; or a CSV file with ``image, x0_px, y0_px``.
    progress : callable, optional
        Called with (done, total) after each image.

    Returns
    -------
    ImagePoints
        All points of the target in each image; those not found are NaN and flagged.

    Raises
    ------
    InputError
        If an image, the target or the pattern cannot be used, or one exposure occurs twice.
    DetectionError
        If a target is not, or not unambiguously, in an image; the message names the image.

    Warns
    -----
    CloseRangeWarning
        Of a board that looks the same after half a turn, and of what the images suffer from.
    """
    if not isinstance(target, Target):
        target = read_target(target)
    sources = _sources(images, placement)
    names = _Names(placement, placement_pattern)
    offsets = read_crops(crops) if isinstance(crops, (str, Path)) else crops
    _warn_if_symmetric(target)
    found: ImagePoints | None = None
    for done, frame in enumerate(distinct(_frames(sources, camera)), start=1):
        points = _detect_one(frame, target, names, estimator)
        if offsets is not None:
            points = points.shifted(_offset_of(frame, offsets))
        found = points if found is None else _joined(found, points, frame)
        if progress:
            progress(done, len(sources))
    assert found is not None  # noqa: S101  # there is at least one source
    return found


def read_crops(path: Path | str) -> dict[str, tuple[float, float]]:
    """Read where crops were cut out: CSV with ``image, x0_px, y0_px``.

    Parameters
    ----------
    path : Path or str
        The file; `image` is a file name without folders.

    Returns
    -------
    dict of str to (float, float)
        Full-image px of each crop's pixel (0, 0).

    Raises
    ------
    TableError
        If a row breaks the contract.
    """
    table = read_csv(path, required=("image", "x0_px", "y0_px"))
    corners = zip(table.floats("x0_px"), table.floats("y0_px"), strict=True)
    return dict(zip(table.texts("image"), corners, strict=True))


@dataclass(frozen=True, slots=True)
class _Names:
    """How an image's placement and reading are named."""

    placement: str | None
    pattern: str | None

    def of(self, frame: Frame) -> tuple[str, str]:
        """Return placement and reading."""
        if self.placement is not None:
            return self.placement, ""
        return placement_and_reading(Path(frame.source), self.pattern)


def _sources(images: Images, placement: str | None) -> list[Path | Frame]:
    """List the images; folders give theirs."""
    listed: Iterable[str | Path | Frame] = (
        [images] if isinstance(images, (str, Path, Frame)) else images
    )
    sources: list[Path | Frame] = []
    for image in listed:
        sources.extend([image] if isinstance(image, Frame) else list_images(Path(image)))
    if not sources:
        raise InputError("no image was named", remedy="name at least one image or folder")
    if placement is not None and len(sources) > 1:
        raise InputError(
            f"one placement name for {len(sources)} images",
            remedy="use --placement-pattern, or name one image",
        )
    return sources


def _frames(sources: Iterable[Path | Frame], camera: str) -> Iterator[Frame]:
    """Read images one by one, so that few are in memory at a time."""
    for source in sources:
        yield source if isinstance(source, Frame) else read_image(source, camera=camera)


def _warn_if_symmetric(target: Target) -> None:
    board = target.pattern
    if isinstance(board, Chessboard) and board.half_turn_symmetric and not board.orientation:
        warnings.warn(
            f"a board of {board.rows} x {board.columns} inner corners looks the same after half a "
            "turn: it is taken to be upright in every image, an upside-down one goes unnoticed; a "
            "board with one odd and one even number has no such doubt; where this one is held "
            'upright, write orientation = "upright" into its file',
            CloseRangeWarning,
            stacklevel=3,
        )


def _detect_one(frame: Frame, target: Target, names: _Names, estimator: str) -> ImagePoints:
    placement, reading = names.of(frame)
    try:
        check_frame(frame)
        return detect_target(
            frame, target, placement=placement, reading=reading, estimator=estimator
        )
    except DetectionError as error:
        if frame.source and frame.source not in error.message:
            raise DetectionError(f"{frame.source}: {error.message}", remedy=error.remedy) from error
        raise


def _joined(found: ImagePoints, points: ImagePoints, frame: Frame) -> ImagePoints:
    try:
        return found + points
    except CloseRangeError as error:
        raise InputError(f"{frame.source}: {error.message}", remedy=error.remedy) from error


def _offset_of(frame: Frame, offsets: Mapping[str, tuple[float, float]]) -> np.ndarray:
    name = Path(frame.source).name
    if name not in offsets:
        raise InputError(
            f"{frame.source}: no row for {name!r} in the table of crops", remedy="add the row"
        )
    return np.array(offsets[name])
