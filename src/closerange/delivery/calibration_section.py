"""The section on the calibration: parameters, what was fixed, residuals, layout."""

from __future__ import annotations

import numpy as np

from closerange.delivery.excerpts import shown
from closerange.delivery.facts import fact_blocks
from closerange.delivery.layout3d import Group, draw_layout, draw_points, paper_up
from closerange.delivery.plots import magnification, vector_plot
from closerange.delivery.sheet import Block, Contents, Figure, Paragraph, Section, Table
from closerange.delivery.svg import BLUE, GREEN, VERMILION
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
    "k1": ("radial distortion k1", "none"),
    "k2": ("radial distortion k2", "none"),
    "k3": ("radial distortion k3", "none"),
    "p1": ("decentring p1", "none"),
    "p2": ("decentring p2", "none"),
    "rx": ("small turn about the camera's x", "rad"),
    "ry": ("small turn about the camera's y", "rad"),
    "rz": ("small turn about the camera's z", "rad"),
    "tx": ("translation along the camera's x", "mm"),
    "ty": ("translation along the camera's y", "mm"),
    "tz": ("translation along the camera's z", "mm"),
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
            draw_layout(rig),
            "Cameras and measuring volume in parallel projection, axes in mm; dashed: "
            "optical axes.",
        )
    )
    if len(rig.residuals):
        blocks.append(_points_figure(rig))
        blocks.append(_residual_table(rig.residuals))
        blocks += _residual_figures(rig)
        blocks += _left_out_points(rig.residuals)
    if rig.parameters:
        blocks.append(_parameter_table(rig))
    blocks += fact_blocks("How the model was chosen and what was fixed", rig.report)
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
        Group("check point: not fitted", _unique(xyz[check]), (GREEN,)),
        Group("outlier: left out", _unique(xyz[outlier]), (VERMILION,)),
    ]
    title = "Control points in the measuring volume"
    picture = draw_points(
        groups,
        volume_mm=rig.volume_mm,
        up=paper_up(rig.cameras, rig.volume_mm),
        title=title,
        description=f"{len(_unique(xyz))} places",
    )
    return Figure(picture, f"{title} (box), axes in mm; thin lines lead down to the floor.")


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
    rows = []
    for camera in rig.cameras:
        names, places = rig.parameters_of(camera.name)
        for name, place in zip(names, places, strict=True):
            words, unit = _PARAMETERS.get(name, (name, DASH))
            # the rotation is stored as a matrix; its parameters are small turns after it
            value = (
                DASH if name in ("rx", "ry", "rz") else _value(rig, camera.name, name, std[place])
            )
            rows.append((camera.name, words, name, value, significant(float(std[place]), 2), unit))
    head = ("camera", "parameter", "symbol", "value", "standard deviation", "unit")
    caption = "Free parameters (rotations are small turns after the stored attitude, hence 0)"
    return Table(caption, head, rows, texts=frozenset({0, 1, 2, 5}))


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
