"""Images that belong together: one placement is one set, taken at one moment by all cameras."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from closerange.errors import InputError
from closerange.images.folder import natural_key
from closerange.images.frame import Frame

_SHOWN = 8  # orphans named in a message; the rest is counted


@dataclass(frozen=True, slots=True, eq=False)
class ImageSet:
    """One image from each camera, taken together.

    Attributes
    ----------
    placement : str
        Name of the state of the world that they show.
    paths : dict of str to Path
        Camera name: image file.
    reading : str
        Which of several repeated sets of one placement; empty when there is one.
    """

    placement: str
    paths: dict[str, Path]
    reading: str = ""


def placement_name(path: Path | str, pattern: str | None = None) -> str:
    """Return the placement that an image's file name stands for.

    Parameters
    ----------
    path : Path or str
        The image file.
    pattern : str, optional
        Regular expression, searched for in the name without its ending; its first group is
        the placement. Without it the whole name is.

    Returns
    -------
    str
        The placement's name.

    Raises
    ------
    InputError
        If the pattern is no regular expression, has no group or does not match.
    """
    return placement_and_reading(path, pattern)[0]


def placement_and_reading(path: Path | str, pattern: str | None = None) -> tuple[str, str]:
    r"""Return the placement and the reading that an image's file name stands for.

    Parameters
    ----------
    path : Path or str
        The image file.
    pattern : str, optional
        As in `placement_name`. A group named ``reading`` is the reading, for instance
        ``r"(.+)_(?P<reading>\d+)"``; the first other group is the placement.

    Returns
    -------
    tuple of str
        Placement and reading; the reading is empty without such a group.

    Raises
    ------
    InputError
        As `placement_name`.
    """
    stem = Path(path).stem
    if pattern is None:
        return stem, ""
    try:
        regex = re.compile(pattern)
    except (re.error, OverflowError, RecursionError) as error:
        raise InputError(
            f"the placement pattern {pattern!r} is no regular expression: {error}",
            remedy=r"write for instance '(\d+)$' for the number at the end of the name",
        ) from error
    reading_group = regex.groupindex.get("reading", 0)
    groups = [group for group in range(1, regex.groups + 1) if group != reading_group]
    if not groups:
        raise InputError(
            f"the placement pattern {pattern!r} has no group for the placement",
            remedy=r"put the part that names the placement in brackets, for instance '(\d+)$'",
        )
    match = regex.search(stem)
    placement = match.group(groups[0]) if match else None
    reading = match.group(reading_group) if match and reading_group else ""
    if not placement or reading is None:
        raise InputError(
            f"{path}: the placement pattern {pattern!r} finds nothing in {stem!r}",
            remedy="correct the pattern, or move files that are no measuring images elsewhere",
        )
    return placement, reading


def group_images(
    paths_by_camera: Mapping[str, Sequence[Path]], *, pattern: str | None = None
) -> list[ImageSet]:
    """Put the images of all cameras together by placement.

    Parameters
    ----------
    paths_by_camera : mapping of str to sequence of Path
        Camera name: its image files, in any order.
    pattern : str, optional
        How a file name gives the placement, and perhaps the reading; see
        `placement_and_reading`.

    Returns
    -------
    list of ImageSet
        In natural order of placement, then reading.

    Raises
    ------
    InputError
        If there is no camera or no image, if two images of a camera have one placement and
        reading, or if an image has no partner in another camera: all orphans are listed.
    """
    if not paths_by_camera:
        raise InputError("no camera was given", remedy="give at least one camera with images")
    keyed = {camera: _by_key(camera, paths, pattern) for camera, paths in paths_by_camera.items()}
    keys = set().union(*keyed.values())
    if not keys:
        raise InputError(
            f"no images for the cameras {', '.join(keyed)}", remedy="name their folders or files"
        )
    common = keys.intersection(*keyed.values())
    if common != keys:
        raise _orphans(keyed, common)
    ordered = sorted(keys, key=lambda key: (natural_key(key[0]), natural_key(key[1])))
    return [
        ImageSet(key[0], {camera: paths[key] for camera, paths in keyed.items()}, key[1])
        for key in ordered
    ]


def check_duplicates(frames: Iterable[Frame]) -> None:
    """Refuse images whose pixels are identical; two exposures never are.

    Parameters
    ----------
    frames : iterable of Frame
        Frames of one or several cameras; each is looked at once and not kept.

    Raises
    ------
    InputError
        If one camera's image occurs twice, or one image stands for two cameras. Both files
        are named.
    """
    for _ in distinct(frames):
        pass


def distinct(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Pass frames on, one by one, as long as no pixels come twice.

    Parameters
    ----------
    frames : iterable of Frame
        As in `check_duplicates`.

    Yields
    ------
    Frame
        The same frames in the same order.

    Raises
    ------
    InputError
        As `check_duplicates`, when the second of two equal frames is reached.
    """
    seen: dict[bytes, tuple[str, str]] = {}
    for frame in frames:
        digest = hashlib.sha256(f"{frame.pixels.dtype.str}{frame.pixels.shape}".encode())
        digest.update(np.ascontiguousarray(frame.pixels).data)
        key = digest.digest()
        if key in seen:
            camera, source = seen[key]
            raise _duplicate(frame, camera, source)
        seen[key] = (frame.camera, frame.source)
        yield frame


def _by_key(camera: str, paths: Sequence[Path], pattern: str | None) -> dict[tuple[str, str], Path]:
    """Return a camera's files by placement and reading."""
    keyed: dict[tuple[str, str], Path] = {}
    for path in map(Path, paths):
        key = placement_and_reading(path, pattern)
        if key in keyed:
            raise InputError(
                f"camera {camera!r}: {keyed[key]} and {path} are both {_key_text(key)}",
                remedy="remove one, or tell repetitions apart by a (?P<reading>...) group "
                "in the placement pattern",
            )
        keyed[key] = path
    return keyed


def _orphans(
    keyed: dict[str, dict[tuple[str, str], Path]], common: set[tuple[str, str]]
) -> InputError:
    """List the images that lack a partner, and the cameras that lack one."""
    lines = []
    for camera, paths in keyed.items():
        for key in sorted(set(paths) - common, key=lambda key: natural_key(key[0] + key[1])):
            lacking = ", ".join(other for other in keyed if key not in keyed[other])
            lines.append(f"{paths[key]} ({_key_text(key)} of {camera}) is missing in {lacking}")
    more = f"; and {len(lines) - _SHOWN} more" if len(lines) > _SHOWN else ""
    counts = ", ".join(f"{camera} {len(paths)}" for camera, paths in keyed.items())
    return InputError(
        f"images without a partner (images: {counts}): " + "; ".join(lines[:_SHOWN]) + more,
        remedy="add the missing images or remove the orphans"
        if common
        else r"no name occurs in all cameras: give a placement pattern such as '(\d+)$' "
        "that finds the common part of the names",
    )


def _duplicate(frame: Frame, camera: str, source: str) -> InputError:
    """Say that two images are the same."""
    here, there = _name(frame.camera, frame.source), _name(camera, source)
    if frame.camera == camera:
        return InputError(
            f"{there} and {here} have identical pixels: one exposure occurs twice",
            remedy="remove one of them, or check that the camera was not frozen",
        )
    return InputError(
        f"{there} and {here} have identical pixels: one image stands for two cameras",
        remedy="check the folders or file names that were given for these cameras",
    )


def _name(camera: str, source: str) -> str:
    """Name a frame in a message."""
    return f"{source or 'a frame'} (camera {camera!r})"


def _key_text(key: tuple[str, str]) -> str:
    """Name a placement, and the reading if there is one."""
    return f"placement {key[0]!r}" + (f", reading {key[1]!r}" if key[1] else "")
