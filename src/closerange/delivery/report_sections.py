"""Sections on the measurement: how it was done, calibration, pictures, points, positions."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby

import numpy as np

from closerange.delivery.excerpts import shown
from closerange.delivery.overlays import common_factor, draw_overlay
from closerange.delivery.plots import axis_panels, panel_grid
from closerange.delivery.sheet import Block, Contents, Figure, Paragraph, Section, Table
from closerange.delivery.volume_plots import draw_slices
from closerange.delivery.wording import (
    FLAG_WORDS,
    counted,
    fixed,
    flag_names,
    micrometres,
    mm,
    significant,
)
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.position.positions import Positions
from closerange.rig.rig import Rig

MIN_READINGS = 20
"""Readings at one position from which on their sequence is worth a figure."""


def measured_section(contents: Contents) -> Section | None:
    """Say with what and how it was measured.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    Section or None
        None if there is nothing to say.
    """
    blocks: list[Block] = []
    if contents.rig is not None:
        blocks += [Paragraph(_rig_sentence(contents.rig)), _cameras_table(contents.rig)]
    sentences = []
    if contents.points is not None:
        points = contents.points
        sentences.append(
            f"{int(points.found.sum())} of {counted(len(points), 'image point')} were found by "
            f"{counted(len(points.cameras), 'camera')} in "
            f"{counted(len(set(points.placement)), 'placement')}."
        )
    if contents.positions is not None:
        positions = contents.positions
        sentences.append(
            f"{int(positions.measured.sum())} of {counted(len(positions), 'position')} were "
            f"measured in {counted(len(set(positions.placement)), 'placement')}."
        )
    if sentences:
        blocks.append(Paragraph(" ".join(sentences)))
    return Section("measured", "How it was measured", tuple(blocks)) if blocks else None


def prediction_section(contents: Contents) -> Section | None:
    """Show the predicted error of each axis in the volume."""
    error_map = contents.error_map
    if error_map is None:
        return None
    std, part = error_map.std_mm, error_map.calibration_std_mm
    rows = []
    for axis, name in enumerate("XYZ"):
        known = std[np.isfinite(std[:, axis]), axis]
        own = part[np.isfinite(part[:, axis]), axis]
        if known.size:
            figures = (_rms(known), known.min(), known.max(), _rms(own))
            rows.append((name, *(micrometres(float(value)) for value in figures)))
    text = (
        "One standard deviation of a single position, from the image noise found in the "
        "calibration and from the uncertainty of the calibration itself. Only the first part is "
        "averaged away by repeated readings."
    )
    head = (
        "axis",
        "rms in the volume [µm]",
        "smallest [µm]",
        "largest [µm]",
        "of it calibration (rms) [µm]",
    )
    blocks: list[Block] = [Paragraph(text), Table("Predicted error", head, rows)]
    blocks += [
        Figure(
            draw_slices(error_map, axis),
            f"Predicted error of {'XYZ'[axis]} [µm] at three heights; seen along Z.",
        )
        for axis in range(3)
    ]
    return Section("prediction", "Predicted error in the volume", tuple(blocks))


def pictures_section(contents: Contents) -> Section | None:
    """Show the images with what was found on them."""
    if not contents.overlays:
        return None
    text = (
        "Every image with the points found on it: ellipses are the fitted outlines of discs, "
        "crosses their centres (cyan: good; orange: flagged, with the flag's name). Yellow arrows "
        "are residuals of the calibration, observed minus calculated, magnified as stated."
    )
    blocks: list[Block] = [Paragraph(text)]
    factor = common_factor(contents.overlays)
    for overlay in contents.overlays:
        found = int(np.isfinite(overlay.xy_px).all(axis=1).sum())
        words = [f"Camera {overlay.camera}"]
        if overlay.placement:
            words.append(f"placement {overlay.placement}")
        words.append(f"{found} of {counted(len(overlay.point), 'point')} found")
        if np.isfinite(overlay.residual_px).any():
            words.append(f"residuals magnified {significant(factor)} times")
        width, height = overlay.size_px
        source = f" ({overlay.file_name})" if overlay.file_name else ""
        caption = f"{', '.join(words)}; image {width} x {height} px{source}."
        blocks.append(Figure(draw_overlay(overlay, factor=factor), caption, half=True))
    return Section("pictures", "Pictures with detected points", tuple(blocks))


def points_section(contents: Contents) -> Section | None:
    """Count points, camera by camera."""
    points = contents.points
    if points is None or not len(points):
        return None
    rows = [_points_row(points.of_camera(camera), camera) for camera in points.cameras]
    head = (
        *("camera", "placements", "points", "found", "flagged"),
        *("median std x [px]", "median std y [px]"),
    )
    blocks: list[Block] = [Table("Image points of each camera", head, rows)]
    bad = points.select(points.flags != 0)
    cells = [
        (
            *(bad.camera[i], bad.placement[i], bad.point[i]),
            *(fixed(float(value), 2) for value in bad.xy_px[i]),
            ", ".join(flag_names(int(bad.flags[i]))),
        )
        for i in range(len(bad))
    ]
    if cells:
        names = ("camera", "placement", "point", "x [px]", "y [px]", "flags")
        blocks.append(shown(cells, "Flagged points", names, texts=frozenset({0, 1, 2, 5})))
    return Section("points", "Image points", tuple(blocks))


def positions_section(contents: Contents) -> Section | None:
    """Show measured positions and, if there are enough, readings at one position."""
    positions = contents.positions
    if positions is None or not len(positions):
        return None
    std = np.sqrt(np.einsum("mii->mi", positions.cov_mm2))
    good = positions.measured & (positions.flags == 0)
    residual = positions.residual_px[np.isfinite(positions.residual_px)]
    rows = [
        ("positions", str(len(positions)), ""),
        ("measured", str(int(positions.measured.sum())), ""),
        ("without a flag", str(int(good.sum())), ""),
        ("residual (rms)", fixed(_rms(residual), 3), "px"),
        *(
            (f"predicted standard deviation of {name} (median)", _median_um(std[:, axis]), "µm")
            for axis, name in enumerate("XYZ")
        ),
    ]
    blocks: list[Block] = [Table("Positions", ("figure", "value", "unit"), rows, frozenset({0, 2}))]
    blocks += _readings(positions)
    blocks.append(_positions_table(positions, std))
    return Section("positions", "Positions", tuple(blocks))


def flags_section(contents: Contents) -> Section | None:
    """Explain in words every flag that occurs."""
    rig = contents.rig
    columns = [
        ("image points", None if contents.points is None else contents.points.flags),
        ("calibration points", None if rig is None else rig.residuals.flags),
        ("positions", None if contents.positions is None else contents.positions.flags),
    ]
    present = [(name, flags) for name, flags in columns if flags is not None and len(flags)]
    checked = [name for cell in _document_flags(contents) for name in cell.split("|")]
    rows = []
    for bit in Flag:
        counts = [int(((flags & int(bit)) != 0).sum()) for _, flags in present]
        counts += [checked.count(str(bit.name))] if contents.checks else []
        if any(counts):
            rows.append((str(bit.name), FLAG_WORDS[bit], *map(str, counts)))
    if not rows:
        return None
    text = "A flag always means a defect; rows without a flag are not listed here."
    last = ("verified rows",) if contents.checks else ()
    head = ("flag", "meaning", *(name for name, _ in present), *last)
    table = Table("Flags that occur", head, rows, texts=frozenset({0, 1}))
    return Section("flags", "Flags", (Paragraph(text), table))


def _document_flags(contents: Contents) -> Iterator[str]:
    """Yield the flag cells of all verification results."""
    for check in contents.checks:
        yield from check["rows"].get("flags", ())
        # rows of a single-point test are positions; readings left out are not among them
        for row in check.get("left_out", ()) if check["kind"] == "single-point" else ():
            yield row[-1]


def _rig_sentence(rig: Rig) -> str:
    size = " x ".join(fixed(float(side), 0) for side in rig.volume_mm[1] - rig.volume_mm[0])
    residuals = rig.residuals
    fitted = int(np.asarray(residuals.fitted).sum())
    placements = counted(len(set(residuals.placement)), "placement")
    return (
        f"{counted(len(rig.cameras), 'camera')} were calibrated to one world frame with the model "
        f"'{rig.model}', from {fitted} of {counted(len(residuals), 'image point')} in "
        f"{placements}. The measuring volume is {size} mm (X, Y, Z)."
    )


def _cameras_table(rig: Rig) -> Table:
    middle = rig.volume_mm.mean(axis=0)
    first = _direction(rig, 0, middle)
    rows = []
    for i, camera in enumerate(rig.cameras):
        depth = float(camera.depth_mm(middle)[0])
        angle = np.degrees(np.arccos(np.clip(_direction(rig, i, middle) @ first, -1, 1)))
        rows.append(
            (
                camera.name,
                f"{camera.size_px[0]} x {camera.size_px[1]}",
                fixed(float(np.linalg.norm(camera.centre_mm - middle)), 0),
                fixed(depth / float(camera.matrix_px[0, 0]), 3),
                fixed(float(angle), 1) if i else "reference",
            )
        )
    head = (
        "camera",
        "image [px]",
        "distance to the volume's middle [mm]",
        "size of a pixel there [mm]",
        "angle to the first camera [degrees]",
    )
    return Table("Cameras", head, rows)


def _direction(rig: Rig, index: int, middle_mm: FloatArray) -> FloatArray:
    """Return the unit vector from the volume's middle to a camera."""
    away: FloatArray = rig.cameras[index].centre_mm - middle_mm
    return away / np.linalg.norm(away)


def _points_row(points: ImagePoints, camera: str) -> tuple[str, ...]:
    std = np.sqrt(np.einsum("nii->ni", points.cov_px2))
    return (
        camera,
        str(len(set(points.placement))),
        str(len(points)),
        str(int(points.found.sum())),
        str(int((points.flags != 0).sum())),
        *(fixed(_median(std[:, axis]), 4) for axis in (0, 1)),
    )


def _readings(positions: Positions) -> list[Block]:
    """Draw the readings at the position that has the most (figure 3.2: 100 readings)."""
    keys = list(zip(positions.placement, positions.point, strict=True))
    known = [key for key, is_known in zip(keys, positions.measured, strict=True) if is_known]
    counts = {key: len(list(group)) for key, group in groupby(sorted(known))}
    if not counts or max(counts.values()) < MIN_READINGS:
        return []
    key = max(counts, key=lambda name: counts[name])
    rows = [i for i, other in enumerate(keys) if other == key and positions.measured[i]]
    xyz = positions.xyz_mm[rows]
    mean, std = xyz.mean(axis=0), xyz.std(axis=0, ddof=1)
    panels = axis_panels(
        1000 * (xyz - mean),
        unit="µm",
        quantity="reading minus mean",
        x_label="number of the reading",
        mark="chain",
    )
    name = ", ".join(filter(None, (key[0] and f"placement {key[0]}", f"point {key[1]}")))
    caption = (
        f"{len(rows)} readings at one position ({name}); mean X {mm(mean[0])} Y {mm(mean[1])} "
        f"Z {mm(mean[2])} mm; standard deviation X {micrometres(std[0])} Y {micrometres(std[1])} "
        f"Z {micrometres(std[2])} µm."
    )
    title = "Readings at one position"
    picture = panel_grid(panels, columns=1, height=108, title=title, description=caption)
    return [Figure(picture, caption)]


def _positions_table(positions: Positions, std_mm: FloatArray) -> Table:
    several = any(positions.reading)
    cells = [
        (
            positions.placement[i],
            *((positions.reading[i],) if several else ()),
            positions.point[i],
            *map(mm, positions.xyz_mm[i]),
            *(micrometres(float(value)) for value in std_mm[i]),
            fixed(float(positions.residual_px[i]), 3),
            str(int(positions.cameras[i])),
            ", ".join(flag_names(int(positions.flags[i]))),
        )
        for i in range(len(positions))
    ]
    names = ("placement", *(("reading",) if several else ()), "point")
    head = (
        *names,
        *(f"{axis} [mm]" for axis in "XYZ"),
        *(f"std {axis} [µm]" for axis in "XYZ"),
        *("residual [px]", "cameras", "flags"),
    )
    texts = frozenset({*range(len(names)), len(head) - 1})
    marked = frozenset(i for i, flag in enumerate(positions.flags) if flag)
    caption = "Measured positions with their predicted standard deviation"
    return shown(cells, caption, head, texts=texts, marked=marked, wide=True)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _median_um(values_mm: FloatArray) -> str:
    return micrometres(_median(values_mm))
