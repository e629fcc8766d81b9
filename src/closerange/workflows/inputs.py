"""What a result was made from: programs with their versions, files with their SHA-256."""

from __future__ import annotations

import os.path
import platform
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
import scipy

from closerange.files import sha256
from closerange.version import __version__


def versions() -> dict[str, str]:
    """Return the versions of the program and of what computes for it.

    Returns
    -------
    dict of str to str
        The same on every run of one installation.
    """
    return {
        "program": f"closerange {__version__}",
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "opencv": cv2.__version__,
    }


def input_hashes(files: Sequence[Path | str]) -> dict[str, str]:
    """Return the SHA-256 of files by name.

    Parameters
    ----------
    files : sequence of path
        Files of any folders; one that is named twice counts once.

    Returns
    -------
    dict of str to str
        Digests by the last parts of each path, with ``/``: as many parts as it takes to tell the
        files apart, the same number for all. Usually that is the file's name alone: folders
        above belong to the machine, not to the measurement.

    Raises
    ------
    FileError
        If a file cannot be read.
    """
    if not files:
        return {}
    # not resolved: a link is named as the user names it
    paths = list(dict.fromkeys(Path(os.path.abspath(file)) for file in files))  # noqa: PTH100
    parts = [path.parts[1:] for path in paths]  # without the drive or root
    count = 1
    while len({part[-count:] for part in parts}) < len(parts):
        count += 1
    names = ("/".join(part[-count:]) for part in parts)
    return {name: sha256(path) for name, path in zip(names, paths, strict=True)}


def copy_inputs(names: Iterable[str], source: Path, folder: Path) -> None:
    """Copy a project's inputs, so that its results can be made again from the copy.

    Parameters
    ----------
    names : iterable of str
        Paths within the project.
    source : Path
        The project's folder.
    folder : Path
        Where the copies go; made if it is missing.
    """
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source / name, folder / name)
