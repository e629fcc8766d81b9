"""Sections on the measurement: how it was done, what error is predicted, pictures, flags."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from closerange.delivery.overlays import common_factor, draw_overlay
from closerange.delivery.sheet import Block, Contents, Figure, Paragraph, Section, Table
from closerange.delivery.volume_plots import draw_slices
from closerange.delivery.wording import (
    FLAG_WORDS,
    TIMES,
    counted,
    fixed,
    micrometres,
    significant,
)
from closerange.features.image_points import ImagePoints
from closerange.flags import Flag
from closerange.geometry.arrays import FloatArray
from closerange.matching.correspondences import Correspondences
from closerange.position.positions import Positions
from closerange.rig.rig import Rig


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
    jobs = dict.fromkeys((*contents.points, *contents.positions, *contents.matches))
    sentences = [
        _job_sentence(
            job,
            contents.points.get(job),
            contents.positions.get(job),
            contents.matches.get(job),
        )
        for job in jobs
    ]
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
        "Images with the points found on them, the first ones of each job: ellipses are the "
        "fitted outlines of discs, "
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
        caption = f"{', '.join(words)}; image {width} {TIMES} {height} px{source}."
        picture = draw_overlay(overlay, factor=factor)
        small = overlay.small
        blocks.append(Figure(picture, caption, half=not small, quarter=small))
    return Section("pictures", "Pictures with detected points", tuple(blocks))


def flags_section(contents: Contents) -> Section | None:
    """Explain in words every flag that occurs."""
    rig = contents.rig
    columns = {
        "image points": [points.flags for points in contents.points.values()],
        "matched points": [matches.point_flags for matches in contents.matches.values()],
        "calibration points": [] if rig is None else [rig.residuals.flags],
        "positions": [positions.flags for positions in contents.positions.values()],
    }
    present = [
        (name, np.concatenate(flags))
        for name, flags in columns.items()
        if sum(len(each) for each in flags)
    ]
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


def _job_sentence(
    job: str,
    points: ImagePoints | None,
    positions: Positions | None,
    matches: Correspondences | None,
) -> str:
    """Count what one job found and measured."""
    parts = []
    if matches is not None:
        parts.append(
            f"{int(matches.clean.sum())} of {counted(len(matches), 'point')} matched without a "
            f"flag in {counted(len(matches.cameras), 'view')}"
        )
    if points is not None:
        parts.append(
            f"{int(points.found.sum())} of {counted(len(points), 'image point')} found by "
            f"{counted(len(points.cameras), 'camera')} in "
            f"{counted(len(set(points.placement)), 'placement')}"
        )
    if positions is not None:
        parts.append(
            f"{int(positions.measured.sum())} of {counted(len(positions), 'position')} measured in "
            f"{counted(len(set(positions.placement)), 'placement')}"
        )
    return f"{f'Job {job}: ' if job else ''}{', '.join(parts)}."


def _rig_sentence(rig: Rig) -> str:
    size = f" {TIMES} ".join(fixed(float(side), 0) for side in rig.volume_mm[1] - rig.volume_mm[0])
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
                f"{camera.size_px[0]} {TIMES} {camera.size_px[1]}",
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


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")
