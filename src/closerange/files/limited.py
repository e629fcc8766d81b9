"""Reading with limits: only regular files, only up to a stated size."""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from closerange.errors import FileError

MAX_TEXT_BYTES = 16 * 2**20
"""Largest JSON or TOML file read by default; rigs and results state larger limits of their own."""

MAX_TABLE_BYTES = 512 * 2**20
"""Largest CSV table read (512 MiB: about five million rows)."""


def read_limited(path: Path | str, max_bytes: int) -> bytes:
    """Read a regular file of at most a given size.

    Parameters
    ----------
    path : Path or str
        The file. Symbolic links are followed; devices, pipes and folders are refused.
    max_bytes : int
        Size limit in bytes.

    Returns
    -------
    bytes
        The content.

    Raises
    ------
    FileError
        If the file is missing, unreadable, not regular, empty or larger than the limit.
    """
    path = Path(path)
    try:
        # O_NONBLOCK: opening a named pipe must not wait for a writer
        handle = os.open(
            path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        )
        with os.fdopen(handle, "rb") as stream:
            status = os.fstat(stream.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise FileError(f"{path}: not a regular file", remedy="name a file on disk")
            if status.st_size > max_bytes:
                raise FileError(
                    f"{path}: {status.st_size} bytes, the limit is {max_bytes}",
                    remedy="split the file or name the right one",
                )
            content = stream.read(status.st_size + 1)  # reserves what it is asked for
    except FileNotFoundError as error:
        raise FileError(f"{path}: no such file", remedy="check the path") from error
    except IsADirectoryError as error:
        raise FileError(f"{path}: is a folder", remedy="name a file in it") from error
    except OSError as error:
        raise FileError(
            f"{path}: {error.strerror or error}", remedy="check the path and its rights"
        ) from error
    except ValueError as error:  # a NUL byte in the path
        raise (
            error if isinstance(error, FileError) else FileError(f"{str(path)!r}: {error}")
        ) from error
    if not content:
        raise FileError(f"{path}: the file is empty", remedy="write it again")
    return content


def read_text(path: Path | str, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a UTF-8 text file, with or without a byte-order mark.

    Parameters
    ----------
    path : Path or str
        The file.
    max_bytes : int, optional
        Size limit in bytes.

    Returns
    -------
    str
        The text with line ends as they are in the file.

    Raises
    ------
    FileError
        As `read_limited`, and if the file is not UTF-8.
    """
    try:
        return read_limited(path, max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FileError(
            f"{path}: not UTF-8 text (byte {error.start})", remedy="save the file as UTF-8"
        ) from error


def sha256(path: Path | str) -> str:
    """Return the SHA-256 of a file as 64 hexadecimal digits.

    Parameters
    ----------
    path : Path or str
        The file.

    Returns
    -------
    str
        Lower-case digest.

    Raises
    ------
    FileError
        If the file cannot be read.
    """
    try:
        with Path(path).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        reason = getattr(error, "strerror", None) or error
        raise FileError(f"{path}: {reason}", remedy="check the path") from error
