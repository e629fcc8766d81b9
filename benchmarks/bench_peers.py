"""Calibration, positions and detection beside other programs, on the same data in one run.

    python benchmarks/bench_peers.py [--quick] [--check] [--shared ../shared]

Each table has medians over repeats, ratios to this program on the same data (medians of paired
ratios) and the spread of the times; lost comparisons stay in. ``--check`` exits 1 if this program's
error is more than 5 % larger than the best peer's in any judged column. Accuracy is judged on
points and boards that took no part in the calibration. mrcal and COLMAP are compared where they
are installed.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path

from closerange.errors import CloseRangeWarning
from peer_tables import chessboard, corners, discs, positions
from peer_tables.machine import NoiseMeter, versions
from peer_tables.table import BAR, Bar
from thesis.tables import Lines


def main() -> int:
    """Print all tables; return the exit code."""
    options = _options()
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CloseRangeWarning)
        text, bars = _compare(options)
    print("# Peers\n")
    print(versions() + "\n")
    print("\n".join(text))
    missed = [bar for bar in bars if not bar.held]
    print(f"## Bars: at most {BAR:g} x the best peer's error\n")
    for bar in bars:
        print(f"- {bar}")
    print(f"\n{len(bars) - len(missed)} of {len(bars)} bars hold; ", end="")
    print(f"{time.perf_counter() - start:.0f} s in all.")
    return 1 if options.check and missed else 0


def _compare(options: argparse.Namespace) -> tuple[Lines, list[Bar]]:
    quick, data, seed = options.quick, options.shared / "data", options.seed
    meter = NoiseMeter()
    meter.sample()
    text: Lines = []
    bars: list[Bar] = []
    for lines, found in (
        positions.compare(6 if quick else 40, seed),
        chessboard.compare(data, 2 if quick else 8, seed),
        discs.compare(data, 3 if quick else None, 1 if quick else 3),
        corners.compare(2 if quick else 8, 1 if quick else 3, seed),
    ):
        meter.sample()
        text += lines
        bars += found
    return [str(meter), "", *text], bars


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="few repeats, under 40 s")
    parser.add_argument("--check", action="store_true", help="exit 1 if a bar is missed")
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[1].parent / "shared")
    parser.add_argument("--seed", type=int, default=1)
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
