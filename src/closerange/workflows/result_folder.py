"""A folder of results: it appears whole or not at all, and replaces only one of its kind."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

from closerange.errors import FileError


def check_free(folder: Path, project: Path, *, overwrite: bool) -> None:
    """Refuse a folder that results must not replace, before any work is done.

    Parameters
    ----------
    folder : Path
        Where the results shall go.
    project : Path
        The project file, which must not lie in it.
    overwrite : bool
        Whether an older folder of results may be replaced.

    Raises
    ------
    FileError
        If a file is in the way, or the folder holds the project or anything but results.
    """
    place = folder.resolve()
    nearest = next(part for part in (place, *place.parents) if part.exists())
    if not nearest.is_dir():
        raise FileError(f"{nearest}: is a file", remedy="name a folder")
    if project.resolve().is_relative_to(place):
        raise FileError(
            f"{folder}: the project lies in it, results replace their whole folder",
            remedy="name a folder of their own",
        )
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise FileError(
            f"{folder}: the folder exists and is not empty",
            remedy="name another one, or allow to replace it with --overwrite",
        )
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "run.json").is_file():
        raise FileError(
            f"{folder}: not a folder of results (no run.json in it); it is left alone",
            remedy="name another folder",
        )


def put(folder: Path, write: Callable[[Path], None]) -> None:
    """Fill a folder aside and rename it: an interruption leaves the old one, or none.

    Parameters
    ----------
    folder : Path
        The folder to appear.
    write : callable
        Called with the empty folder that it fills.

    Raises
    ------
    FileError
        If the place cannot be written.
    """
    target = folder.resolve()
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{target.name}.", dir=target.parent) as aside:
            staged, old = Path(aside) / "new", Path(aside) / "old"
            staged.mkdir()
            write(staged)
            if target.exists():
                target.replace(old)
            try:
                staged.replace(target)
            except BaseException:
                if old.exists():
                    old.replace(target)
                raise
    except OSError as error:
        raise FileError(
            f"{folder}: cannot be written ({error.strerror or error})",
            remedy="check that the place is writable and has room",
        ) from error
