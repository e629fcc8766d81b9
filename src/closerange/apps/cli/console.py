"""What every verb does around its work: errors, warnings, JSON."""

from __future__ import annotations

import functools
import json
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ParamSpec, TextIO

import typer

from closerange.errors import CloseRangeError, CloseRangeWarning

P = ParamSpec("P")

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect it."""

DEFECT = 70
"""Exit code of a mistake in the program itself (EX_SOFTWARE of sysexits.h): neither the command
nor the data are to blame."""

TOO_LARGE = CloseRangeError(
    "the memory does not suffice", remedy="use smaller or fewer images at a time"
)

_shown: list[str] = []  # warnings of the command that runs, for its JSON summary
_kept: list[str] = []  # files that it has written, in case it is interrupted


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a verb has to tell.

    Attributes
    ----------
    text : str
        One screen for people.
    summary : dict
        The same for machines.
    notes : tuple of str
        Warnings that were caught on the way.
    failure : CloseRangeError or None
        Why what was written cannot be used; its exit code becomes the command's.
    """

    text: str
    summary: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    failure: CloseRangeError | None = field(default=None)


def verb(command: Callable[P, Outcome]) -> Callable[P, None]:
    """Turn a function that returns an outcome into a command.

    Parameters
    ----------
    command : callable
        The verb. Its argument ``_json``, which it needs not look at, asks for JSON.

    Returns
    -------
    callable
        Prints the outcome, warnings to stderr, and errors as ``error:`` and ``remedy:``; never a
        traceback. With JSON, stdout gets exactly one object, whatever happens.
    """

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        as_json = bool(kwargs.get("_json"))
        _shown.clear()
        _kept.clear()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", CloseRangeWarning)
                warnings.showwarning = _show_warning
                outcome = command(*args, **kwargs)
            code = _tell(outcome, as_json=as_json)
        except CloseRangeError as error:
            code = tell_error(error, as_json=as_json)
        except KeyboardInterrupt:
            code = _tell_interruption(as_json=as_json)
        except MemoryError:
            code = tell_error(TOO_LARGE, as_json=as_json)
        except Exception as defect:  # noqa: BLE001  # whatever it is: words, not a traceback
            code = _tell_defect(defect, as_json=as_json)
        raise typer.Exit(code)

    return wrapped


def keep(path: Path) -> None:
    """Note that a file is written, whole, for what is said after Ctrl-C."""
    _kept.append(str(path))


def tell_error(error: CloseRangeError, *, as_json: bool, code: int | None = None) -> int:
    """Say what is wrong and what to do about it, to people and, if asked for, to machines.

    Parameters
    ----------
    error : CloseRangeError
        What happened.
    as_json : bool
        Also print it as JSON on stdout.
    code : int, optional
        Exit code, if not the error's own.

    Returns
    -------
    int
        The exit code.
    """
    code = error.exit_code if code is None else code
    _print_error(error)
    if as_json:
        _print_json({"error": _described(error, code)})
    return code


def _tell(outcome: Outcome, *, as_json: bool) -> int:
    for note in outcome.notes:
        echo(f"warning: {note}", to_stderr=True)
    echo(outcome.text, to_stderr=as_json)
    failure = outcome.failure
    if failure is not None:
        _print_error(failure)
    if as_json:
        code = 0 if failure is None else failure.exit_code
        wrong = {} if failure is None else {"error": _described(failure, code)}
        _print_json({**outcome.summary, **wrong})
    return 0 if failure is None else failure.exit_code


def _tell_interruption(*, as_json: bool) -> int:
    what = f"written, whole: {', '.join(_kept)}" if _kept else "nothing was written"
    echo(f"\ninterrupted: {what}", to_stderr=True)
    if as_json:
        error = CloseRangeError(f"interrupted: {what}", remedy="run the command again")
        _print_json({"error": _described(error, INTERRUPTED, kind="KeyboardInterrupt")})
    return INTERRUPTED


def _tell_defect(defect: Exception, *, as_json: bool) -> int:
    """Name the place of a mistake in the program: enough for a report, without a traceback."""
    frames = traceback.extract_tb(defect.__traceback__)
    place = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    error = CloseRangeError(
        f"a defect of closerange, not of your data: {type(defect).__name__}: {defect}{place}",
        remedy="please report this line with the command and its files",
    )
    return tell_error(error, as_json=as_json, code=DEFECT)


def _described(error: CloseRangeError, code: int, *, kind: str = "") -> dict[str, Any]:
    return {
        "message": error.message,
        "remedy": error.remedy,
        "exit_code": code,
        "kind": kind or type(error).__name__,
    }


def _print_error(error: CloseRangeError) -> None:
    for label, text in (("error: ", error.message), ("remedy: ", error.remedy)):
        if text:
            echo(label + text.replace("\n", "\n" + " " * len(label)), to_stderr=True)


def _print_json(summary: Mapping[str, Any]) -> None:
    """Print one object with the warnings; what is not finite becomes null."""
    whole = {"warnings": list(dict.fromkeys(_shown)), **summary}
    echo(json.dumps(_finite(whole), ensure_ascii=False, indent=1), to_stderr=False)


def echo(text: str, *, to_stderr: bool) -> None:
    """Print a text; a reader that went away, as ``head`` does, is no reason to fail.

    Parameters
    ----------
    text : str
        What to print.
    to_stderr : bool
        Where to.
    """
    stream = sys.stderr if to_stderr else sys.stdout
    try:
        _write(stream, text + "\n")
    except BrokenPipeError:
        # the interpreter flushes once more when it ends: let that go nowhere
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _write(stream: TextIO, text: str) -> None:
    """Write; a character that the terminal lacks, as in a file's name, is written as a number."""
    try:
        stream.write(text)
    except UnicodeEncodeError:
        encoding = stream.encoding or "ascii"
        stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
    stream.flush()


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _shown.append(str(message))
    echo(f"warning: {message}", to_stderr=True)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
