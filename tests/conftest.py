"""Fixtures of all tests."""

from __future__ import annotations

from pathlib import Path

import pytest

SHARED = Path(__file__).parents[1].parent / "shared"


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of shared data beside the repository; tests that need it skip without it."""
    if not (SHARED / "data").is_dir():
        pytest.skip("needs the shared data folder beside the repository")
    return SHARED
