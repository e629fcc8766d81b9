"""The section on the calibration: parameters, what was fixed, residuals, layout."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from closerange.delivery.excerpts import shown
from closerange.delivery.facts import fact_blocks
from closerange.delivery.layout3d import Group, draw_layout, draw_points, paper_up
from closerange.delivery.lens_blocks import lens_blocks
from closerange.delivery.plots import magnification, vector_plot
from closerange.delivery.sheet import Block, Contents, Figure, Paragraph, Section, Table
from closerange.delivery.svg import BLUE, FULL_WIDTH, GREEN, VERMILION
from closerange.delivery.wording import (
    DASH,
    FLAG_WORDS,
    fixed,
    printed,
    significant,
    three_micrometres,
)
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.rig.rig import Residuals, Rig

_PARAMETERS = {
    "fx": ("focal length along x", "px"),
    "fy": ("focal length along y", "px"),
    "cx": ("principal point x", "px"),
    "cy": ("principal point y", "px"),
    "skew": ("skew", "px"),
    "k1": ("radial distortion k1", "pure\u00a0number"),
    "k2": ("radial distortion k2", "pure\u00a0number"),
    "k3": ("radial distortion k3", "pure\u00a0number"),
    "p1": ("decentring p1", "pure\u00a0number"),
    "p2": ("decentring p2", "pure\u00a0number"),
    "rx": ("small turn about x", "rad"),
    "ry": ("small turn about y", "rad"),
    "rz": ("small turn about z", "rad"),
    "tx": ("translation along x", "mm"),
    "ty": ("translation along y", "mm"),
    "tz": ("translation along z", "mm"),
}


def calibration_section(contents: Contents) -> Section | None:
    """Write everything behind the calibration.

    Parameters
    ----------
    contents : Contents
        Only its rig is used.

    Returns
    -------
    Section or None
        None without a rig.
    """
    rig = contents.rig
    if rig is None:
        return None
    blocks: list[Block] = [*_trust(rig)]
    blocks.append(
        Figure(
            draw_layout(rig, width=FULL_WIDTH / 2),
            "Cameras and measuring volume in parallel projection, axes in mm; dashed: "
            "optical axes.",
            half=True,
        )
    )
    if len(rig.residuals):
        blocks.append(_points_figure(rig))
        blocks.append(_residual_table(rig.residuals))
        blocks += _residual_figures(rig)
        blocks += _left_out_points(rig.residuals)
    if rig.parameters:
        blocks.append(_parameter_table(rig))
    blocks += lens_blocks(rig.cameras)
    blocks += fact_blocks("How it was calculated and what was fixed", _other_facts(rig.report))
    return Section("calibration", "Calibration", tuple(blocks))


def _trust(rig: Rig) -> list[Block]:
    if rig.trust is None:
        return []
    tone = {"good": "good", "fair": "warn", "untrustworthy": "bad"}[rig.trust.verdict]
    text = (
        f"Trust: {rig.trust.verdict}. The predicted error of one position inside the measuring "
        f"volume is {three_micrometres(rig.trust.predicted_mm)}; of it "
        f"{three_micrometres(rig.trust.calibration_mm)} come from the calibration and cannot be "
        f"averaged away. The image noise is {fixed(rig.noise_px, 4)} px for one coordinate "
        f"({rig.dof} degrees of freedom)."
    )
    reasons = [Paragraph(printed(reason), tone) for reason in rig.trust.reasons]
    return [Paragraph(text, tone), *reasons]


def _points_figure(rig: Rig) -> Figure:
    residuals = rig.residuals
    outlier = (residuals.flags & int(Flag.outlier)) != 0
    check = ~residuals.fitted & ~outlier
    xyz = residuals.xyz_mm
    groups = [
        Group("fitted", _unique(xyz[residuals.fitted]), (BLUE,)),
        Group("check point", _unique(xyz[check]), (GREEN,)),
        Group("outlier", _unique(xyz[outlier]), (VERMILION,)),
    ]
    title = "Control points in the measuring volume"
    picture = draw_points(
        groups,
        volume_mm=rig.volume_mm,
        up=paper_up(rig.cameras, rig.volume_mm),
        title=title,
        description=f"{len(_unique(xyz))} places",
    )
    return Figure(picture, f"{title} (box), axes in mm; thin lines lead to the floor.", half=True)


def _unique(xyz_mm: FloatArray) -> FloatArray:
    """Keep one row of each place: several cameras see the same point."""
    return np.unique(xyz_mm, axis=0)


def _residual_table(residuals: Residuals) -> Table:
    rows = []
    names = np.array(residuals.camera)
    for camera in dict.fromkeys(residuals.camera):
        own = names == camera
        fitted = residuals.residual_px[own & residuals.fitted]
        other = residuals.residual_px[own & ~residuals.fitted]
        length = np.linalg.norm(fitted, axis=1)
        rows.append(
            (
                camera,
                str(len(fitted)),
                *(fixed(_rms(fitted[:, axis]), 4) for axis in (0, 1)),
                *(fixed(float(value), 4) for value in _mean(fitted)),
                fixed(float(length.max()), 4) if len(length) else DASH,
                str(len(other)),
                fixed(_rms(np.linalg.norm(other, axis=1)), 4) if len(other) else DASH,
            )
        )
    head = (
        *("camera", "fitted points", "rms x [px]", "rms y [px]", "mean x [px]", "mean y [px]"),
        *("largest [px]", "points not fitted", "their rms length [px]"),
    )
    return Table("Residuals in the images (observed minus calculated)", head, rows)


def _residual_figures(rig: Rig) -> list[Block]:
    residuals = rig.residuals
    names = np.array(residuals.camera)
    figures: list[Block] = []
    for camera in rig.cameras:
        own = names == camera.name
        if not own.any():
            continue
        vectors = residuals.residual_px[own]
        fitted = np.asarray(residuals.fitted)[own]
        factor = magnification(np.linalg.norm(vectors[fitted], axis=1), camera.size_px)
        title = f"Residuals of camera {camera.name}"
        picture = vector_plot(
            residuals.xy_px[own],
            vectors,
            size_px=camera.size_px,
            odd=~fitted,
            factor=factor,
            title=title,
            description=f"{int(own.sum())} vectors magnified {significant(factor)} times",
        )
        caption = f"{title}: observed minus calculated, magnified {significant(factor)} times."
        figures.append(Figure(picture, caption, half=True))
    return figures


def _left_out_points(residuals: Residuals) -> list[Block]:
    rows = []
    for i in np.flatnonzero(~np.asarray(residuals.fitted)):
        flag = Flag(int(residuals.flags[i]))
        reasons = [FLAG_WORDS[bit] for bit in Flag if bit & flag]
        rows.append(
            (
                *(residuals.camera[i], residuals.placement[i], residuals.point[i]),
                *(fixed(float(value), 3) for value in residuals.residual_px[i]),
                "; ".join(reasons) or "check point, kept out on purpose",
            )
        )
    if not rows:
        return [Paragraph("All points took part in the fit; none was rejected.")]
    head = ("camera", "placement", "point", "residual x [px]", "residual y [px]", "why")
    return [shown(rows, "Points that were not fitted", head, texts=frozenset({0, 1, 2, 5}))]


def _parameter_table(rig: Rig) -> Table:
    std = np.sqrt(np.clip(np.diag(rig.parameter_cov), 0, None))
    rows: list[tuple[str, ...]] = []
    for camera in rig.cameras:
        names, places = rig.parameters_of(camera.name)
        for name, place in zip(names, places, strict=True):
            words, unit = _PARAMETERS.get(name, (name, DASH))
            # the rotation is stored as a matrix; its parameters are small turns after it
            value = (
                DASH if name in ("rx", "ry", "rz") else _value(rig, camera.name, name, std[place])
            )
            spread = significant(float(std[place]), 2)
            rows.append((camera.name, words, name, value, spread, unit, "free"))
        rows += _fixed_rows(camera.name, rig.report)
    head = ("camera", "parameter", "symbol", "value", "standard deviation", "unit", "free or fixed")
    caption = "Parameters (turns and translations in the camera's axes; turns have no value)"
    return Table(caption, head, rows, texts=frozenset({0, 1, 2, 5, 6}), wide=True)


def _fixed_rows(camera: str, report: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """List what was not estimated, and why, where the calibration says so."""
    rows: list[tuple[str, ...]] = []
    for name, fact in _facts_of(camera, report).items():
        if isinstance(fact, Mapping) and fact.get("free") is False:
            words, unit = _PARAMETERS.get(name, (name, DASH))
            value = significant(float(fact.get("value") or 0.0), 6)
            rows.append((camera, words, name, value, DASH, unit, f"fixed: {fact.get('why', '')}"))
    return rows


def _facts_of(camera: str, report: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a calibration's report says of the parameters of a camera."""
    found: Any = report
    for key in ("cameras", camera, "parameters"):
        found = found.get(key) if isinstance(found, Mapping) else None
    return found if isinstance(found, Mapping) else {}


def _other_facts(report: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out of a report what the table of parameters shows."""
    facts = dict(report)
    cameras = facts.get("cameras")
    if isinstance(cameras, Mapping):
        facts["cameras"] = {
            name: {key: value for key, value in fact.items() if key != "parameters"}
            if isinstance(fact, Mapping)
            else fact
            for name, fact in cameras.items()
        }
    return facts


def _value(rig: Rig, camera: str, name: str, std: float) -> str:
    """Write a parameter down to the second digit of its standard deviation."""
    try:
        value = rig.camera(camera).parameter(name)
    except (KeyError, AttributeError):  # a lens or linear model with terms of its own
        return DASH
    if not (np.isfinite(std) and std > 0):
        return significant(value, 6)
    return fixed(value, int(np.clip(1 - np.floor(np.log10(std)), 0, 9)))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _mean(values: FloatArray) -> FloatArray:
    return values.mean(axis=0) if len(values) else np.full(2, np.nan)
