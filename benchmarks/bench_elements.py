"""The structuring elements of the default matcher: its choice per point against every fixed one.

    python benchmarks/bench_elements.py [--others] [--sensitivity] [--scene FOLDER --z MIN MAX]

The default matcher asks several structuring elements and weights them, for each point, by what the
images say about them (`closerange.matching.element_weights`). Here 24 fixed elements take their
place, four shapes of six sizes, everything else being equal: the same candidates, the same other
terms of the cost, the same smoothing afterwards. Points are those at which there is a choice:
strong edge points visible in both views that have a candidate within 1 px and another one further
away. Three figures for each pair of views, the share of them that is right,

element   by the elements' misfit, and the turn of the candidate's own edge, alone
unary     by the whole cost of a candidate, with the greys beside the edge
smoothed  after the agreement along chains

for the worst and the best fixed element (which differs from pair to pair and which nobody knows
beforehand), the choice, the hindsight oracle (right if any of the 24 is) and the share of the gap
between the best fixed one and the oracle that is closed. The standard error of the gain takes
edges (chains) as independent, not points. The choice may pass the oracle: it knows slanted edges.

The second table turns it round: for each fixed element the mean lead over the choice, in how many
pairs it is better and in how many worse by more than two standard errors, and its best and its
worst pair.

`--others` adds further pairs of views of the same scenes; `--scene` takes any folder of their
layout instead, all pairs of its cameras. `--sensitivity` varies the constants of the choice.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from numpy.typing import NDArray

from bench_structuring import FRAMES, OTHERS, RENDERED, RIGHT_PX, SCENES, Z_MM
from closerange.features.edge_chains import chain_numbers
from closerange.features.edges import find_edges
from closerange.matching import element_weights, evidence
from closerange.matching.candidates import find_candidates, sweep_axis
from closerange.matching.continuity import choose
from closerange.matching.depth_table import (
    MISFIT_LIMIT_PX,
    DepthTable,
    Element,
    Line,
    Square,
    Strip,
)
from closerange.matching.element_weights import best_rows
from closerange.matching.matcher import strong_edges
from closerange.matching.pencil import Pencil
from closerange.matching.search import between_planes
from matching.element_shapes import Kernels
from matching.scene_truth import Kind, SceneTruth

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

HALF_WIDTHS = (0.0125, 0.02, 0.031, 0.05, 0.08, 0.125)
"""Half-widths of squares per image width, in steps of 1.6; discs and bars are as large."""

HALF_LENGTHS = (0.008, 0.016, 0.031, 0.0625, 0.125, 0.25)
"""Half-lengths of strips, points of the chain to each side per image width."""

STAGES = ("element", "unary", "smoothed")

VARIANTS: dict[str, dict[str, Any]] = {
    "as is": {},
    "squares x 0.5": {"SQUARES": (0.01, 0.0225, 0.047)},
    "squares x 0.7": {"SQUARES": (0.014, 0.032, 0.066)},
    "squares x 1.4": {"SQUARES": (0.028, 0.063, 0.13)},
    "squares x 2": {"SQUARES": (0.04, 0.09, 0.188)},
    "without the smallest": {"SQUARES": (0.045, 0.094)},
    "strips x 0.5": {"STRIPS": (0.031, 0.125)},
    "strips x 2": {"STRIPS": (0.125, 0.5)},
    "without the long strip": {"STRIPS": (0.0625,)},
    "without the short strip": {"STRIPS": (0.25,)},
    "slant price x 0.5": {"SLANT_PRICE": 0.25 * MISFIT_LIMIT_PX},
    "slant price x 0.7": {"SLANT_PRICE": 0.35 * MISFIT_LIMIT_PX},
    "slant price x 1.4": {"SLANT_PRICE": 0.7 * MISFIT_LIMIT_PX},
    "no slant": {"SLANT_PRICE": MISFIT_LIMIT_PX},
    "elsewhere x 0.5": {"ELSEWHERE_PX": 0.75},
    "elsewhere x 2": {"ELSEWHERE_PX": 3.0},
    "all elements alike": {"POWER": 0},
    "weights: margin": {"POWER": 1},
    "weights: margin^4": {"POWER": 4},
}


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """Which of M visible edge points are right, at each stage: shape (stages, M)."""

    fixed: dict[str, BoolArray]
    chosen: BoolArray
    chain: NDArray[np.int64]

    def gain(self, rival: BoolArray) -> tuple[float, float]:
        """Return the lead of the choice over a rival and its standard error, as shares."""
        apart = self.chosen.astype(float) - rival
        per_chain = np.bincount(self.chain, apart - apart.mean())
        return float(apart.mean()), float(np.sqrt((per_chain**2).sum())) / len(apart)


class Views:
    """One pair of views: visible edge points, their candidates, and what is true."""

    def __init__(self, folder: Path, first: str, second: str, z_mm: tuple[float, float]) -> None:
        truth = SceneTruth(folder, first, second)
        frame = FRAMES.get(folder.name, "")
        images = [cv2.imread(str(folder / f"{name}{frame}.png"), 0) for name in (first, second)]
        self.greys = (images[0].astype(np.float32), images[1].astype(np.float32))
        self.edges, there = (find_edges(image) for image in images)
        known = truth.of(self.edges.xy_px, self.edges.tangent)
        visible = (known.kind == int(Kind.edge)) & truth.seen(known.xyz_mm)
        self.pencil = Pencil.of(truth.first, truth.second)
        volume = between_planes(*z_mm)
        self.candidates = find_candidates(self.pencil, self.edges, there, volume)
        away = self.candidates.xy_px - known.xy_px[self.candidates.point]
        self.is_right = np.linalg.norm(away, axis=1) < RIGHT_PX
        self.visible = np.flatnonzero(visible & strong_edges(images[0], self.edges))
        good, all_ = (
            np.bincount(self.candidates.point[rows], minlength=len(self.edges))[self.visible]
            for rows in (self.is_right, slice(None))
        )
        self.points = self.visible[(good > 0) & (good < all_)]
        self.line = Line.of(self.edges.after)
        self.turned = np.clip(
            evidence.turn(self.edges, self.candidates) / evidence.TURN_RAD, 0.0, MISFIT_LIMIT_PX
        )
        self.axis = sweep_axis(self.pencil)

    def table(self) -> DepthTable:
        """Make the table of misfits."""
        origin_mm = float(self.pencil.first.centre_mm[self.axis])
        return DepthTable.of(self.line, self.candidates, self.turned, self.axis, origin_mm)

    def fixed(self) -> dict[str, FloatArray]:
        """Return the misfit of every candidate within every fixed element."""
        width, points = self.edges.size_px[0], self.edges.xy_px
        elements: dict[str, Element] = {}
        for share in HALF_WIDTHS:
            half = share * width
            # 1.13 and 1.73: of equal area
            elements[f"square {2 * half:.0f}"] = Square.of(self.line, points, half)
            elements[f"disc {2.26 * half:.0f}"] = Kernels.disc(self.edges, self.line, 1.13 * half)
            elements[f"bar {3.46 * half:.0f}"] = Kernels.bar(self.edges, self.line, 1.73 * half)
        for share in HALF_LENGTHS:
            reach = round(share * width)
            elements[f"strip {2 * reach + 1}"] = Strip.of(self.line, reach)
        misfits = self.table().means(self.candidates, list(elements.values()))
        return dict(zip(elements, misfits, strict=True))

    def choice(self) -> FloatArray:
        """Return the misfit of every candidate within the elements that suit its point."""
        return element_weights.support(self.edges, self.candidates, self.table())

    def right(self, misfit: FloatArray) -> BoolArray:
        """Tell which points are right at each stage, shape (stages, M)."""
        with mock.patch.object(evidence, "support", return_value=misfit):
            cost = evidence.unary_cost(self.edges, self.candidates, self.greys, self.pencil)
        agreed = choose(self.edges, self.candidates, cost, self.axis).candidate
        rows = [self._best(misfit + evidence.TURN_WEIGHT * self.turned), self._best(cost), agreed]
        picked = np.stack(rows)[:, self.points]
        return np.where(picked >= 0, self.is_right[picked], False)

    def _best(self, cost: FloatArray) -> NDArray[np.int64]:
        row = np.full(len(self.edges), -1, np.int64)
        best = best_rows(cost, self.candidates.point)
        row[self.candidates.point[best]] = best
        return row

    def outcome(self) -> Outcome:
        """Try all elements, and the choice."""
        fixed = {name: self.right(misfit) for name, misfit in self.fixed().items()}
        chain = chain_numbers(self.edges.after)[self.points]
        return Outcome(fixed, self.right(self.choice()), chain)


def report(name: str, outcome: Outcome) -> None:
    """Print the three stages of one pair."""
    every = np.stack(list(outcome.fixed.values()))  # elements, stages, points
    names = list(outcome.fixed)
    for stage, label in enumerate(STAGES):
        share = every[:, stage].mean(axis=1)
        best = int(np.argmax(share))
        single = Outcome({}, outcome.chosen[stage], outcome.chain)
        gain, error = single.gain(every[best, stage])
        count = every[:, stage].sum(axis=0)
        oracle = (count > 0).mean()
        gap = oracle - share[best]
        closed = f"{100 * gain / gap:5.0f}" if gap > 0.0005 else "  n/a"
        print(
            f"  {name if not stage else '':27s}{len(single.chosen) if not stage else '':>6} "
            f"{label:9s}{100 * share.min():6.1f} {100 * share[best]:6.1f}  {names[best]:11s}"
            f"{100 * single.chosen.mean():6.1f} {100 * gain:+5.1f} +-{100 * error:4.1f}"
            f"{100 * oracle:7.1f} {100 * (count > 1).mean():6.1f} {closed}",
            flush=True,
        )


def rivals(outcomes: dict[str, Outcome]) -> None:
    """Print for each fixed element how it stands against the choice over all pairs."""
    print(
        f"\nFixed elements against the choice, {len(outcomes)} pairs of views; points of per cent"
    )
    print(
        f"  {'':12s}" + "".join(f"{stage + ': mean':>15s} better worse  most " for stage in STAGES)
    )
    for name in next(iter(outcomes.values())).fixed:
        row = ""
        for stage in range(len(STAGES)):
            singles = [
                Outcome({}, o.chosen[stage], o.chain).gain(o.fixed[name][stage])
                for o in outcomes.values()
            ]
            lead, error = np.array(singles).T
            row += (
                f"{-100 * lead.mean():+15.1f} {(lead < -2 * error - 1e-9).sum():6d} "
                f"{(lead > 2 * error + 1e-9).sum():5d} {-100 * lead.min():+5.1f}/"
                f"{-100 * lead.max():+.0f}"
            )
        print(f"  {name:12s}{row}")


def sensitivity(pairs: dict[str, Views]) -> None:
    """Print the sum over pairs, at each stage, for other constants."""
    print(f"\nOther constants: per cent right, mean of {len(pairs)} pairs; the worst change of any")
    for label, changes in VARIANTS.items():
        with mock.patch.multiple(element_weights, **(changes or {"POWER": element_weights.POWER})):
            share = np.array([v.right(v.choice()).mean(axis=1) for v in pairs.values()])
        if not changes:
            usual = share
        change = 100 * (share - usual)
        print(
            f"  {label:24s}"
            + "".join(f"{100 * m:7.2f}" for m in share.mean(axis=0))
            + "   worst "
            + "".join(f"{c:+6.1f}" for c in change.min(axis=0))
            + "   best "
            + "".join(f"{c:+6.1f}" for c in change.max(axis=0)),
            flush=True,
        )


def pairs_of(options: argparse.Namespace) -> Iterator[tuple[Path, str, str]]:
    """Name the pairs of views."""
    for folder in options.scene:
        cameras = ["left", "right"]
        cameras += ["third"] if (folder / "truth_third.npz").is_file() else []
        for first in cameras:
            for second in cameras:
                if first != second:
                    yield folder, first, second
    if not options.scene:
        for name in SCENES:
            yield options.folder / name, "left", "right"
        for name, first, second in OTHERS if options.others else ():
            yield options.folder / name, first, second


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", type=Path, action="append", default=[], metavar="FOLDER")
    parser.add_argument("--z", type=float, nargs=2, default=Z_MM, metavar=("MIN", "MAX"))
    parser.add_argument("--folder", type=Path, default=RENDERED)
    parser.add_argument("--others", action="store_true")
    parser.add_argument("--sensitivity", action="store_true")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(
        "  pair                       points stage     worst   best fixed         chosen  gain",
        end="",
    )
    print("          oracle  twice closed %")
    outcomes, pairs = {}, {}
    for folder, first, second in pairs_of(options):
        name = f"{folder.name} {first} > {second}"
        pairs[name] = Views(folder, first, second, tuple(options.z))
        outcomes[name] = pairs[name].outcome()
        report(name, outcomes[name])
    rivals(outcomes)
    if options.sensitivity:
        sensitivity(pairs)


if __name__ == "__main__":
    main()
