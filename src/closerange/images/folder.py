"""Folders of images, in the order in which a person counts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from closerange.errors import FileError
from closerange.images.decode import SUFFIXES

_DIGITS = re.compile(r"(\d+)", re.ASCII)


def natural_key(text: str) -> tuple[tuple[Any, ...], str]:
    """Return a sorting key that puts ``image2`` before ``image10``.

    Parameters
    ----------
    text : str
        For instance a file name.

    Returns
    -------
    tuple
        Texts without regard to case alternate with numbers; the text itself breaks ties, so
        that the order never depends on how the folder was listed.
    """
    parts = _DIGITS.split(text)
    key: list[Any] = [part.casefold() for part in parts]
    for at in range(1, len(parts), 2):
        number = parts[at].lstrip("0")
        key[at] = (len(number), number)  # as int(), without its limit of 4300 digits
    return tuple(key), text


def list_images(folder_or_file: Path | str) -> list[Path]:
    """List the images of a folder in natural order.

    Parameters
    ----------
    folder_or_file : Path or str
        A folder, without its subfolders; or one file, which is returned whatever its ending.

    Returns
    -------
    list of Path
        Files ending in .png, .jpg, .jpeg, .jpe, .jfif, .tif, .tiff, .bmp or .dib, whatever
        the case. Hidden files (a leading dot) are left out.

    Raises
    ------
    FileError
        If the path does not exist, cannot be listed or holds no image.
    """
    path = Path(folder_or_file)
    try:
        if path.is_file():
            return [path]
        entries = [entry for entry in path.iterdir() if _is_image(entry)]
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        what = getattr(error, "strerror", None) or error
        raise FileError(f"{str(path)!r}: {what}", remedy="check the path and its rights") from error
    if not entries:
        raise FileError(
            f"{path}: no image in this folder (endings: {' '.join(SUFFIXES)})",
            remedy="name the folder that holds the images themselves, not one above it",
        )
    return sorted(entries, key=lambda entry: natural_key(entry.name))


def _is_image(path: Path) -> bool:
    """Tell whether a folder's entry is a visible file with an image's ending."""
    return not path.name.startswith(".") and path.suffix.lower() in SUFFIXES and path.is_file()
