"""Write docs/thesis-reproduced.md: the thesis' numbers recomputed, this program's beside them.

    python benchmarks/thesis_reproduced.py                 write the page
    python benchmarks/thesis_reproduced.py --check         compare with the committed page
    python benchmarks/thesis_reproduced.py --data FOLDER   folder laid out as the demonstration data

Nothing is random but the seeded synthetic scenes: the same data give the same page.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from thesis.evaluation import (
    centroid_section,
    distortion_section,
    envelope_section,
    heights_section,
)
from thesis.misprints import misprints_section
from thesis.parameters import parameters_section
from thesis.positions import averages_section, dots_section, read_run
from thesis.tables import RUNS, Lines, differences

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "thesis-reproduced.md"
PACKAGE_DATA = ROOT / "src" / "closerange" / "workflows" / "demo_data"

OURS_BEGIN = "## The same experiments with this program"
OURS_END = "## Misprints and how they were read"

# Another version of OpenCV, NumPy or the processor's mathematics changes detected centres in
# the fifth digit, and calibrated results by well under 5 % of their small errors.
SHARE = 0.05


def introduction() -> Lines:
    """Say what the page is, where its numbers come from and how to get it again."""
    return [
        "# The thesis, reproduced",
        "",
        (
            "This program builds on M. T. Boraie, *Close range 3-D position sensing using stereo "
            "vision and point-of-correspondence through mathematical morphology*, PhD thesis, "
            "University of Windsor, 1989 (<https://scholar.uwindsor.ca/etd/8623>). Here its "
            "printed numbers are recomputed from its own tables, the same experiments are repeated "
            "with this program, and what is misprinted is listed with the reading that was chosen."
        ),
        "",
        "The page is generated; do not edit it. From a checkout:",
        "",
        "```sh",
        "python benchmarks/thesis_reproduced.py           # write this page",
        "python benchmarks/thesis_reproduced.py --check   # exit 1 if the page is out of date",
        "```",
        "",
        "The thesis' numbers are in `data/thesis`, with the log of every repaired digit.",
        "",
    ]


def printed_part() -> Lines:
    """Recompute what the thesis prints; depends on data/thesis alone."""
    runs = [read_run(points) for points in RUNS]
    return [
        "## What is printed, recomputed",
        "",
        *averages_section(runs),
        *dots_section(runs),
        *parameters_section(),
        *envelope_section(),
        *heights_section(),
        *centroid_section(),
        *distortion_section(),
    ]


def our_part(data: Path) -> Lines:
    """Repeat the experiments with this program."""
    from thesis.ours import experiments_section  # noqa: PLC0415  # OpenCV: only when needed

    return [OURS_BEGIN, "", *experiments_section(data)]


def assemble(*parts: Lines) -> str:
    """Join lines into a page without doubled blank lines."""
    lines: Lines = []
    for line in (line for part in parts for line in part):
        if line or (lines and lines[-1]):
            lines.append(line)
    return "\n".join(lines).rstrip("\n") + "\n"


def without_ours(page: str) -> str:
    """Leave out this program's own figures, which depend on library versions."""
    before, _, rest = page.partition(OURS_BEGIN)
    _, end, after = rest.partition(OURS_END)
    return before + end + after


def whole_page(data: Path) -> str:
    """Return the page as Markdown."""
    return assemble(introduction(), printed_part(), our_part(data), misprints_section())


def printed_page() -> str:
    """Return the page without this program's own figures."""
    return assemble(introduction(), printed_part(), misprints_section())


def check(page: str) -> int:
    """Compare with the committed page; return the exit code."""
    committed = PAGE.read_text(encoding="utf-8")
    found = differences(without_ours(committed), without_ours(page))
    found += differences(committed, page, share=SHARE) if not found else []
    for line in found:
        print(line, file=sys.stderr)
    print(f"{PAGE.name}: {'out of date' if found else 'up to date'}")
    return 1 if found else 0


def main() -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="compare instead of writing")
    parser.add_argument("--data", type=Path, default=PACKAGE_DATA, help="rendered images")
    options = parser.parse_args()
    page = whole_page(options.data)
    if options.check:
        return check(page)
    PAGE.write_text(page, encoding="utf-8")
    print(f"wrote {PAGE.name}: {len(page.splitlines())} lines")
    return 0


if __name__ == "__main__":
    sys.exit(main())
