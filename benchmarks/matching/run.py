"""One method on one scene: its matches, its figures, its cost."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from closerange.errors import CloseRangeError, CloseRangeWarning
from matching.measures import Figures, figures, tail
from matching.memory import peak_mb
from matching.method import Method, UnavailableError
from matching.scenes import Scene

LONG_S = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """What one method did with one scene; `figures` is None where it could not run."""

    scene: str
    method: str
    figures: Figures | None
    seconds: tuple[float, ...] = ()
    memory_mb: float = float("nan")
    one_way_s: float = float("nan")
    tail: dict[str, int] | None = None
    reason: str = ""

    @property
    def median_s(self) -> float:
        """Median of the repeats."""
        return float(np.median(self.seconds)) if self.seconds else float("nan")

    @property
    def us_per_point(self) -> float:
        """Microseconds per point asked for."""
        points = self.figures.points if self.figures else 0
        return 1e6 * self.median_s / points if points else float("nan")

    def as_dict(self) -> dict[str, Any]:
        """Return it ready for JSON; NaN becomes null."""
        entry: dict[str, Any] = {"scene": self.scene, "method": self.method}
        if self.figures is None:
            return {**entry, "not_run": self.reason}
        return _without_nan(
            {
                **entry,
                **self.figures.as_dict(),
                "seconds": list(self.seconds),
                "us_per_point": self.us_per_point,
                "one_way_us_per_point": 1e6 * self.one_way_s / max(self.figures.points, 1),
                "memory_mb": self.memory_mb,
                "tail": self.tail,
            }
        )


def run(method: Method, scene: Scene, repeats: int) -> Result:
    """Run a method once for its matches and memory, then `repeats` times for its time."""

    def work() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CloseRangeWarning)
            return method.match(scene.images, scene.cameras, scene.xy_px, scene.volume_mm)

    start = time.perf_counter()
    try:
        memory, matches = peak_mb(work)
    except UnavailableError as error:
        return Result(scene.name, method.name, None, reason=str(error))
    except (CloseRangeError, ValueError, TypeError, IndexError) as error:
        reason = f"failed: {type(error).__name__}: {str(error).partition(chr(10))[0]}"
        return Result(scene.name, method.name, None, reason=reason)
    first = time.perf_counter() - start
    # what takes so long is not decided by a cold cache
    ways = [matches.one_way_s]
    seconds = [first] if first > LONG_S else []
    for _ in range(0 if seconds else repeats):
        start = time.perf_counter()
        ways.append(work().one_way_s)
        seconds.append(time.perf_counter() - start)
    one_way = float(np.median(ways))
    return Result(
        scene.name,
        method.name,
        figures(scene, matches),
        tuple(seconds),
        memory,
        one_way,
        tail(scene, matches),
    )


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_without_nan(item) for item in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
