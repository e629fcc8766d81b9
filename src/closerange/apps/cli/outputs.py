"""Checks of the files to be written, before hours of work and not after."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from closerange.errors import FileError, InputError


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path | str | None]) -> None:
    """Refuse outputs that could not be written, or that would destroy what is read.

    Parameters
    ----------
    outputs : iterable of Path or None
        Files to be written; None is passed over.
    inputs : iterable of path or None
        Files that are read.

    Raises
    ------
    FileError
        If a folder is missing or not writable, or the file is a folder, a device or
        write-protected.
    InputError
        If one file is to be written twice, or is an input.
    """
    read = {Path(path).resolve(): path for path in inputs if path is not None}
    written: set[Path] = set()
    for path in outputs:
        if path is None:
            continue
        place = path.resolve()
        if place in written:
            raise InputError(
                f"{path}: two outputs have this name", remedy="give -o and --report different names"
            )
        if place in read:
            raise InputError(
                f"{path}: is read by this command; writing it would destroy the input",
                remedy="give the output another name",
            )
        try:
            _check_place(path)
        except OSError as error:  # a name that is too long, a folder that may not be entered
            raise FileError(
                f"{path}: {error.strerror or error}", remedy="name another file"
            ) from error
        written.add(place)


def _check_place(path: Path) -> None:
    if path.is_dir():
        raise FileError(f"{path}: is a folder", remedy="name a file in it")
    if path.exists() and not path.is_file():
        raise FileError(f"{path}: is no regular file", remedy="name a file on disk")
    folder = path.parent
    if not folder.is_dir():
        raise FileError(
            f"{path}: there is no folder {str(folder)!r}", remedy="make the folder first"
        )
    if not os.access(folder, os.W_OK | os.X_OK):
        raise FileError(
            f"{path}: the folder {str(folder)!r} is not writable",
            remedy="name a file in a folder of your own",
        )
    # by its mode as well: for an administrator every file counts as writable
    if path.exists() and not (os.access(path, os.W_OK) and path.stat().st_mode & 0o222):
        raise FileError(
            f"{path}: is write-protected", remedy="name another file, or allow writing to this one"
        )
