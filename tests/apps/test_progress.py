"""The progress bar: silent for a second, then there, whether or not the work reports."""

from __future__ import annotations

import sys
import time

import pytest

from closerange.apps.cli import progress
from closerange.apps.cli.progress import Progress


@pytest.fixture
def terminal(monkeypatch):
    """Make standard error a terminal, and the quiet second short."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "QUIET_S", 0.01)


def _wait(shown):
    """Wait until the clock has opened the bar, at most ten seconds."""
    for _ in range(1000):
        if shown._bar is not None and shown._bar.tasks:
            return [(task.description, task.completed, task.total) for task in shown._bar.tasks]
        time.sleep(0.01)
    pytest.fail("no bar after ten seconds")


@pytest.mark.usefixtures("terminal")
def test_work_that_never_reports_gets_a_bar_without_end():
    with Progress("measuring") as shown:
        assert _wait(shown) == [("measuring", 0, None)]


@pytest.mark.usefixtures("terminal")
def test_a_bar_shows_what_was_reported_before_and_after_it_opened():
    with Progress("calibrating") as shown:
        shown.announce("calibrating", 1, 5)
        assert _wait(shown) == [("calibrating", 1, 5)]
        shown.step("calibrating")(2, 5)
        assert _wait(shown) == [("calibrating", 2, 5)]


def test_short_work_shows_nothing(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(progress, "QUIET_S", 60.0)
    with Progress("measuring") as shown:
        shown.announce("measuring", 1, 2)
    assert shown._bar is None
    shown._open()  # the clock strikes too late
    assert shown._bar is None


def test_without_a_terminal_there_is_no_bar(monkeypatch):
    monkeypatch.setattr(progress, "QUIET_S", 0.0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    with Progress("measuring") as shown:
        time.sleep(0.05)
        assert shown._bar is None
