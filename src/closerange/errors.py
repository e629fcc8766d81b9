"""Errors and warnings of the whole package.

::

    CloseRangeError (ValueError)
    ├── InputError              exit 2   a file, option or argument that cannot be used
    │   ├── FileError                    missing, unreadable, too large, unsafe path
    │   ├── ImageError                   an image file that cannot become a Frame
    │   ├── TableError                   a CSV table: names file, row and column
    │   └── SchemaError                  JSON or TOML of the wrong form
    └── DataError               exit 1   good files whose content cannot give what was asked
        ├── DetectionError               the target is not (unambiguously) in the image
        ├── GeometryError                degenerate or impossible geometry
        └── UntrustedError               a result that exists but must not be believed

    CloseRangeWarning (UserWarning)      goes into the report and the JSON summary

Every message names the value, the limit and, in ``remedy``, what to do.
"""

from __future__ import annotations


class CloseRangeError(ValueError):
    """Base of all errors that a caller can cause.

    Parameters
    ----------
    message : str
        What is wrong: the value found and the limit it breaks.
    remedy : str, optional
        What the user can do about it.
    """

    exit_code = 1

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.remedy = remedy

    def __str__(self) -> str:
        return f"{self.message}\nremedy: {self.remedy}" if self.remedy else self.message


class InputError(CloseRangeError):
    """A file, option or argument that cannot be used; nothing is written."""

    exit_code = 2


class FileError(InputError):
    """A file that is missing, unreadable, too large or at an unsafe path."""


class ImageError(InputError):
    """An image file that cannot become a `Frame`."""


class TableError(InputError):
    """A CSV table that breaks its contract."""


class SchemaError(InputError):
    """A JSON or TOML file of the wrong form."""


class DataError(CloseRangeError):
    """Readable input whose content cannot give what was asked."""


class DetectionError(DataError):
    """A target that is not, or not unambiguously, in the image."""


class GeometryError(DataError):
    """A degenerate or impossible arrangement of points or cameras."""


class UntrustedError(DataError):
    """A result that exists but must not be believed."""


class CloseRangeWarning(UserWarning):
    """Something the user should know; it is repeated in the report and the JSON summary."""
