"""Markdown of the results of one scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from matching.keypoints import keypoint_summary
from matching.measures import Figures, Stage
from matching.methods import OURS
from matching.run import Result
from matching.scene_truth import Kind
from matching.scenes import Scene
from thesis.tables import Lines, fixed, markdown

MANY = 100
"""Points on smooth surfaces from which on they are reported: prints, not a few shadows."""

RIGHT_HEADER = (
    "method",
    "within {px} px %",
    "0.1 px %",
    "left-right: precision / recall %",
    "kept: precision / recall %",
    "0.1 px %",
    "median px, all / along the curve",
    "height median / p95 mm",
    "wrong faces",
    "95 % region holds, px / mm %",
)
COST_HEADER = (
    "method",
    "ms",
    "10-90 %, ms",
    "us per point",
    "one way",
    "memory MB",
    "time ratio",
    "share within {px} px, ratio",
    "p95 height, ratio",
)


def tables(scene: Scene, results: Sequence[Result]) -> Lines:
    """Write what is right, what it costs, and what could not run."""
    ran = [result for result in results if result.figures]
    px = f"{scene.right_px:g}"
    text = [f"## {scene.name}", "", *_points(scene)]
    if ran:
        rows = [_right(result, result.figures) for result in ran if result.figures]
        text += markdown([cell.format(px=px) for cell in RIGHT_HEADER], rows)
        ours = next((result for result in ran if result.method == OURS), None)
        costs = [_cost(result, result.figures, ours) for result in ran if result.figures]
        text += markdown([cell.format(px=px) for cell in COST_HEADER], costs)
    for result in ran:
        if result.tail and result.method.startswith(OURS):
            t = result.tail
            text.append(
                f"{result.method}: {t['outside']} of {t['of']} kept points lie outside of their 95 "
                f"% region; of these {t['wrong']} are off by more than {px} px, {t['truth_open']} "
                f"lie where the truth itself is open by more than 0.1 px, {t['beyond_3_sigma']} "
                f"are beyond three standard deviations (median {t['median_std_um_px'] / 1000} px)."
            )
            text.append("")
    if f_surface := [r for r in ran if r.figures and r.figures.surface >= MANY]:
        text.append("On smooth surfaces (print, shadow, shading; they may move with the light):")
        text += [f"- {r.method}: kept {_pair(r.figures.surface_final)} %" for r in f_surface]
        text.append("")
    if any(result.method.startswith("SIFT") for result in ran):
        text.append(keypoint_summary(scene))
    text += [f"{result.method}: {result.reason}" for result in results if not result.figures]
    return [*text, ""]


def legend() -> Lines:
    """Say how the columns are meant."""
    return [
        (
            "First two columns: before filters, of the points on surface edges that both views "
            "see. Precision: right among kept, occluded points counted as wrong; recall: kept and "
            "right among visible. Heights: along world Z, of kept visible points. A wrong face is "
            "a connected piece of more than 30 kept points that are all wrong. Ratios: to "
            f"{OURS}; share above 1 is better, time and height above 1 is worse. SGBM's and SIFT's "
            "own checks stand for a left-right check. SIFT: a point takes the depth of the nearest "
            "keypoint match within 4 px. ZNCC and the literal matcher are matched back, and must "
            "return within 1.5 px."
        ),
        "",
    ]


def _points(scene: Scene) -> Lines:
    count = {kind.name: int((scene.truth.kind == int(kind)).sum()) for kind in Kind}
    text = [
        f"{len(scene.xy_px)} points: "
        + ", ".join(f"{number} {name}" for name, number in count.items() if number)
        + "."
    ]
    if scene.checks:
        c = scene.checks
        text.append(
            f"Check of the truth: {100 * c['hidden']:.1f} % of the visible edge points are hidden "
            f"in the second view's depth map; {100 * c['no_edge']:.1f} % have no edge of the "
            f"second image within 1.5 px, the others one at {c['median_px']:.2f} px (half a step "
            f"along the chain is 0.25 px); the truth is open by {c['open_px']:.2f} px (median)."
        )
    return text


def _right(result: Result, f: Figures) -> list[str]:
    return [
        result.method,
        _percent(f.raw),
        _percent(f.raw_fine),
        _pair(f.checked),
        _pair(f.final),
        _percent(f.final.within_fine),
        f"{fixed(f.median_px, 3)} / {fixed(f.median_along_px, 3)}",
        f"{fixed(f.height_median, 3)} / {fixed(f.height_p95, 3)}",
        str(f.wrong_faces),
        f"{_percent(f.cover_px)} / {_percent(f.cover_mm)}",
    ]


def _cost(result: Result, f: Figures, ours: Result | None) -> list[str]:
    low, high = 1000 * np.percentile(result.seconds, [10, 90])
    base = ours.figures if ours else None
    return [
        result.method,
        fixed(1000 * result.median_s, 0),
        f"{low:.0f}-{high:.0f}",
        fixed(result.us_per_point, 0),
        fixed(1e6 * result.one_way_s / max(f.points, 1), 1),
        fixed(result.memory_mb, 0),
        fixed(_over(result.median_s, ours.median_s if ours else np.nan), 2),
        fixed(_over(f.raw, base.raw if base else np.nan), 3),
        fixed(_over(f.height_p95, base.height_p95 if base else np.nan), 2),
    ]


def _pair(stage: Stage) -> str:
    return f"{_percent(stage.precision)} / {_percent(stage.recall)}"


def _percent(share: float) -> str:
    return fixed(100 * share, 1)


def _over(value: float, base: float) -> float:
    return value / base if base else float("nan")
