"""Peak memory of a piece of work, as the operating system counts it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

_STATUS, _RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_mb(work: Callable[[], Any]) -> tuple[float, Any]:
    """Run `work`; return by how much it raised the process' resident memory at most, MB.

    Includes what NumPy, OpenCV and threads take. NaN where the system does not tell (only Linux
    with the GNU library does).
    """
    try:
        # what earlier work has freed would be used again without being counted
        ctypes.CDLL("libc.so.6").malloc_trim(0)
        _RESET.write_text("5", encoding="ascii")
        before = _status("VmRSS")
    except (OSError, LookupError):
        return float("nan"), work()
    result = work()
    return (_status("VmHWM") - before) / 1024, result


def _status(key: str) -> float:
    for line in _STATUS.read_text(encoding="ascii").splitlines():
        if line.startswith(key):
            return float(line.split()[1])
    raise LookupError(key)
