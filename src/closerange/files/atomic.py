"""Writing a file whole or not at all."""

from __future__ import annotations

import contextlib
import os
import tempfile
from pathlib import Path

from closerange.errors import FileError


def write_bytes(path: Path | str, content: bytes) -> None:
    """Replace a file with new content, atomically.

    The content goes to a temporary file in the same folder, is forced to disk and then
    renamed over the target. An interruption leaves the old file, or none, never a part.

    Parameters
    ----------
    path : Path or str
        The file; its folder must exist.
    content : bytes
        The whole new content.

    Raises
    ------
    FileError
        If the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    temporary: str | None = None
    try:
        _refuse_folder_or_device(path)
        handle, temporary = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=".part", dir=path.parent
        )
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(_mode_of_new_file(path))
        Path(temporary).replace(path)
    except FileError:
        raise
    except (OSError, ValueError) as error:  # ValueError: a NUL byte in the path
        reason = getattr(error, "strerror", None) or error
        raise FileError(
            f"{path}: cannot be written ({reason})",
            remedy="check that the folder exists, is writable and has room",
        ) from error
    finally:
        if temporary is not None:  # still there only if something, Ctrl-C included, went wrong
            with contextlib.suppress(OSError):
                Path(temporary).unlink()


def write_text(path: Path | str, text: str) -> None:
    """Replace a file with UTF-8 text, atomically; see `write_bytes`.

    Parameters
    ----------
    path : Path or str
        The file.
    text : str
        The whole new content; line ends are written as they are.

    Raises
    ------
    FileError
        As `write_bytes`.
    """
    try:
        content = text.encode("utf-8")
    except UnicodeEncodeError as error:  # half a character, as from a file name in another encoding
        raise FileError(
            f"{path}: cannot be written as UTF-8: {text[error.start]!r} is no character",
            remedy="rename the file or point that it comes from",
        ) from error
    write_bytes(path, content)


def _refuse_folder_or_device(path: Path) -> None:
    if path.is_dir():
        raise FileError(f"{path}: is a folder", remedy="name a file in it")
    if path.exists() and not path.is_file():  # an administrator would replace /dev/null by a table
        raise FileError(f"{path}: is no regular file", remedy="name a file on disk")


def _mode_of_new_file(path: Path) -> int:
    """Keep the rights of a replaced file; otherwise what the umask leaves of 0666."""
    with contextlib.suppress(OSError):
        return path.stat().st_mode & 0o777
    mask = os.umask(0)
    os.umask(mask)
    return 0o666 & ~mask
