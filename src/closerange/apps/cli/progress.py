"""A progress bar for work that takes longer than a second."""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable
from typing import Any, Self

QUIET_S = 1.0
"""Work shorter than this shows no progress."""


class Progress:
    """A progress bar on stderr that appears only when work takes longer than a second.

    A clock opens it, not the first report after a second: work that reports seldom, or never,
    must not look stuck.

    Parameters
    ----------
    what : str, optional
        Shown, without an end in sight, until the work reports steps.
    """

    def __init__(self, what: str = "") -> None:
        self._lock = threading.Lock()
        self._timer = threading.Timer(QUIET_S, self._open)
        self._timer.daemon = True
        self._closed = False
        self._bar: Any = None
        self._tasks: dict[str, Any] = {}
        self._steps: dict[str, tuple[int, int | None]] = {what: (0, None)} if what else {}

    def __enter__(self) -> Self:
        if sys.stderr.isatty():
            self._timer.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._timer.cancel()
        with self._lock:
            self._closed = True
            if self._bar is not None:
                self._bar.stop()

    def announce(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` steps of something are done."""
        with self._lock:
            self._steps[what] = done, total
            if self._bar is not None:
                self._show(what)

    def step(self, what: str) -> Callable[[int, int], None]:
        """Return a callback (done, total) for one thing that is done."""
        return functools.partial(self.announce, what)

    def _show(self, what: str) -> None:
        done, total = self._steps[what]
        if what in self._tasks:
            self._bar.update(self._tasks[what], completed=done, total=total)
        else:
            self._tasks[what] = self._bar.add_task(what, completed=done, total=total)

    def _open(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
        from rich.progress import Progress as Bars

        with self._lock:
            if self._closed:
                return
            self._bar = Bars(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                console=Console(stderr=True),
                transient=True,
            )
            self._bar.start()
            for what in self._steps:
                self._show(what)
