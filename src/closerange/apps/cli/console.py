"""What every verb does around its work: errors, warnings, progress, JSON."""

from __future__ import annotations

import functools
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, Self

import typer

from closerange.errors import CloseRangeError, CloseRangeWarning

P = ParamSpec("P")

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells expect it."""

QUIET_S = 1.0
"""Work shorter than this shows no progress."""

_shown: list[str] = []  # warnings of the command that runs, for its JSON summary


def verb(command: Callable[P, int]) -> Callable[P, None]:
    """Turn a function that returns an exit code into a command.

    Parameters
    ----------
    command : callable
        The verb. A keyword argument ``json_output`` says whether JSON was asked for.

    Returns
    -------
    callable
        Prints warnings to stderr, and errors as ``error:`` and ``remedy:`` without traceback.
    """

    @functools.wraps(command)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> None:
        as_json = bool(kwargs.get("json_output"))
        _shown.clear()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always", CloseRangeWarning)
                warnings.showwarning = _show_warning
                code = command(*args, **kwargs)
        except CloseRangeError as error:
            code = error.exit_code
            _show_error(error, code, as_json=as_json)
        except KeyboardInterrupt:
            code = INTERRUPTED
            typer.echo("\ninterrupted: nothing was written", err=True)
        raise typer.Exit(code)

    return wrapped


def say(text: str, *, json_output: bool) -> None:
    """Print a line for people: to stdout, or to stderr where stdout carries JSON."""
    typer.echo(text, err=json_output)


def print_json(summary: Mapping[str, Any]) -> None:
    """Print a machine-readable summary, with the warnings, on stdout.

    What is not finite becomes null.
    """
    summary = {"warnings": list(dict.fromkeys(_shown)), **summary}
    typer.echo(json.dumps(_finite(summary), ensure_ascii=False, indent=1))


class Progress:
    """A progress bar on stderr that appears only when work takes longer than a second."""

    def __init__(self) -> None:
        self._start = time.monotonic()
        self._bar: Any = None
        self._tasks: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def announce(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of something are done."""
        if self._bar is None:
            if time.monotonic() - self._start < QUIET_S or not sys.stderr.isatty():
                return
            self._open()
        if what not in self._tasks:
            self._tasks[what] = self._bar.add_task(what, total=total)
        self._bar.update(self._tasks[what], completed=done, total=total)

    def step(self, what: str) -> Callable[[int, int], None]:
        """Return a callback (done, total) for one thing that is done."""
        return functools.partial(self.announce, what)

    def _open(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
        from rich.progress import Progress as Bars

        self._bar = Bars(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._bar.start()


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    _shown.append(str(message))
    typer.echo(f"warning: {message}", err=True)


def _show_error(error: CloseRangeError, code: int, *, as_json: bool) -> None:
    first, *rest = error.message.splitlines() or [""]
    typer.echo("\n".join([f"error: {first}", *(f"       {line}" for line in rest)]), err=True)
    if error.remedy:
        typer.echo(f"remedy: {error.remedy}", err=True)
    if as_json:
        print_json({"error": error.message, "remedy": error.remedy, "exit_code": code})


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
