"""The section on matches: what was found and kept, why not the rest, how certain, pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from closerange.delivery.excerpts import shown
from closerange.delivery.histograms import Histogram, draw_histograms
from closerange.delivery.layout3d import paper_up
from closerange.delivery.match_drawings import (
    depth_limits,
    draw_depths,
    draw_element,
    draw_flags,
    draw_strengths,
)
from closerange.delivery.match_pictures import ScenePictures, ViewPicture
from closerange.delivery.sheet import Block, Contents, Figure, Paragraph, Section, Table
from closerange.delivery.wire import draw_wire, neighbours
from closerange.delivery.wording import (
    FLAG_WORDS,
    counted,
    fixed,
    mm,
    percent,
    significant,
)
from closerange.flags import Flag
from closerange.geometry.arrays import BoolArray, FloatArray, all_finite
from closerange.matching.common_view import mean_direction
from closerange.matching.correspondences import Correspondences
from closerange.position.positions import Positions
from closerange.rig.rig import Rig

ADVICE: dict[Flag, str] = {
    Flag.not_found: "look at the image: is the point there?",
    Flag.at_border: "move the part, or the camera, away from the border",
    Flag.saturated: "lower the exposure",
    Flag.ambiguous: "narrow the volume (--z), or add a third camera",
    Flag.aperture: "add a camera that stands elsewhere, or turn the part",
    Flag.occluded: "nothing, if it should be hidden there; otherwise add a camera that sees it",
    Flag.poor_fit: "look at the picture: a thin face, a reflection or a second edge lies beside it",
    Flag.residual: "do not use it: edges of different bodies were taken for one",
    Flag.inconsistent: "do not use it; less clutter or a third camera helps",
    Flag.no_edge: "raise the contrast there, or widen the volume if it may lie outside",
    Flag.outside_image: "move the part into both images",
    Flag.outside_volume: "calibrate a larger volume, or expect a larger error",
    Flag.near_parallel: "place the cameras farther apart",
    Flag.behind_camera: "check that the images and the rig belong together",
    Flag.single_view: "see why there is no match",
    Flag.untrusted: "calibrate again; the report of the calibration says what is missing",
    Flag.beyond_lens: "keep the part nearer to the middle of the image",
}
"""What to do about a flag of a match."""

FEWEST = 20
"""Points without which there is nothing to be seen in a histogram or in space."""

_OTHERWISE = "look at the point in the picture below"


def match_sections(contents: Contents) -> list[Section]:
    """Write one section for each matched scene.

    Parameters
    ----------
    contents : Contents
        What is known.

    Returns
    -------
    list of Section
        In the order of the jobs.
    """
    sections = []
    shown_before: set[ViewPicture] = set()
    for number, (job, matches) in enumerate(contents.matches.items(), start=1):
        title = f"Matches: {job}" if job else "Matches"
        scene = contents.scenes.get(job)
        blocks = _blocks(matches, contents.positions.get(job), scene, contents.rig)
        views = scene.views if scene is not None else ()
        if views and not shown_before.issuperset(views):  # one scene may be matched twice
            blocks.insert(2, _strengths(views))
        shown_before.update(views)
        sections.append(Section(f"matches-{number}", title, tuple(blocks)))
    return sections


def _blocks(
    matches: Correspondences,
    positions: Positions | None,
    scene: ScenePictures | None,
    rig: Rig | None,
) -> list[Block]:
    blocks: list[Block] = [Paragraph(_summary(matches, scene))]
    blocks += [_flags_table(matches)] if matches.point_flags.any() else []
    cameras = [rig.camera(name) for name in matches.cameras] if rig is not None else []
    axis = int(np.argmax(np.abs(mean_direction(cameras)))) if cameras else 2
    place = _places(matches, positions)
    kept = matches.clean & all_finite(place, 1)
    if positions is not None:
        blocks += _precision(matches, positions, kept, axis)
    if scene is not None:
        blocks += _centroids(scene.centroids, matches.cameras)
        blocks += _pictures(matches, scene, place, kept, axis)
    if rig is not None and int(kept.sum()) >= FEWEST:
        blocks.append(_wire(matches, place, kept, axis, rig))
    return blocks


def _summary(matches: Correspondences, scene: ScenePictures | None) -> str:
    first, *others = matches.cameras
    given = matches.found[:, 0]
    kept = matches.clean
    share = percent(float(kept.sum() / max(given.sum(), 1)))
    volume = f", {_volume_text(scene)}, {_method_text(scene)}" if scene is not None else ""
    return (
        f"{counted(int(given.sum()), 'point')} of camera {first} were sought in "
        f"{' and '.join(others)}{volume}. {int(matches.matched.sum())} have a place in at least "
        f"two views; {int(kept.sum())} ({share}) were kept: at least two views see them without "
        "a flag."
    )


def _method_text(scene: ScenePictures) -> str:
    if scene.method == "literal":
        side = f", {scene.element.size_px} px," if scene.element is not None else ""
        return f"by the thesis' structuring element{side} to whole pixels"
    return "by the program's matcher"


def _volume_text(scene: ScenePictures) -> str:
    low, high = scene.volume_mm
    limits = [
        f"{axis} {significant(a)} to {significant(b)}"
        for axis, a, b in zip("XYZ", low, high, strict=True)
        if a is not None and b is not None
    ]
    return f"within {', '.join(limits)} mm" if limits else "without limits in space"


def _flags_table(matches: Correspondences) -> Table:
    """Say how many points each flag concerns, what it means and what to do."""
    flags = matches.point_flags
    kept = matches.clean
    rows = [("kept", str(int(kept.sum())), "two views see it without a flag", "")]
    for bit in Flag:
        count = int(((flags & int(bit)) != 0).sum())
        if count:
            name = str(bit.name)
            rows.append((name, str(count), FLAG_WORDS[bit], ADVICE.get(bit, _OTHERWISE)))
    head = ("flag", "points", "meaning", "what to do")
    caption = "Points by flag; a point may carry several"
    return Table(caption, head, rows, texts=frozenset({0, 2, 3}))


def _places(matches: Correspondences, positions: Positions | None) -> FloatArray:
    """Return the position of each match; NaN where there is none."""
    place = np.full((len(matches), 3), np.nan)
    if positions is not None:
        rows = {key: row for row, key in enumerate(positions.keys())}
        for row, key in enumerate(matches.keys()):
            if key in rows:
                place[row] = positions.xyz_mm[rows[key]]
    return place


def _precision(
    matches: Correspondences, positions: Positions, kept: BoolArray, axis: int
) -> list[Block]:
    """Say how certain the kept points are."""
    rows = {key: row for row, key in enumerate(positions.keys())}
    own = [rows[key] for key, use in zip(matches.keys(), kept, strict=True) if use]
    if not own:
        return []
    std = 1000 * np.sqrt(np.einsum("mii->mi", positions.cov_mm2[own]))
    cells = [
        (name, *(fixed(float(np.nanquantile(std[:, i], q)), 0) for q in (0.05, 0.5, 0.95)))
        for i, name in enumerate("XYZ")
    ]
    outside = int(((positions.flags[own] & int(Flag.outside_volume)) != 0).sum())
    text = "The standard deviations follow from the noise of the edges and from the calibration."
    if outside:
        text += (
            f" {outside} of the {len(own)} kept points lie outside of the calibrated measuring "
            "volume, where the error may be larger."
        )
    head = ("axis", "5 % are below [µm]", "median [µm]", "95 % are below [µm]")
    table = Table("Predicted standard deviation of kept points", head, cells)
    if len(own) < FEWEST:
        return [Paragraph(text), table]
    name = "XYZ"[axis]
    picture = draw_histograms(
        [
            Histogram(
                f"Predicted error in {name}", std[:, axis], f"standard deviation of {name} [µm]"
            ),
            Histogram("Mismatch of the views", matches.mismatch[kept], "mismatch"),
        ]
    )
    caption = (
        "Kept points: predicted standard deviation along the view, and how badly the views fit "
        "there. The last bar holds the uppermost hundredth as well."
    )
    return [Paragraph(text), table, Figure(picture.render(), caption)]


def _centroids(entries: Sequence[Mapping[str, Any]], cameras: tuple[str, ...]) -> list[Block]:
    """Compare matched centroids with those found in the second view (Table 5.3)."""
    if not entries:
        return []
    rows, apart = [], []
    for entry in entries:
        seed, match, found, expected = (
            np.array(entry[f"{name}_px"]) for name in ("seed", "match", "found", "expected")
        )
        apart.append(float(np.linalg.norm(expected - found)))
        cells = [fixed(float(v), 2) for pair in (seed, match, expected, found) for v in pair]
        rows.append((str(entry["point"]), *cells, fixed(apart[-1], 3)))
    first, second = cameras[:2]
    head = (
        *("point", f"{first} x [px]", f"{first} y [px]", f"match in {second} x", "y [px]"),
        *("expected centroid x", "y [px]", f"found in {second} x", "y [px]", "apart [px]"),
    )
    text = (
        "The centroid of each bright face was matched and, independently, found in the second "
        "view. Perspective moves the centre of a face's image by a fraction of a pixel, in each "
        "view another way: the outline of the first view, carried to the height of the match, "
        "gives the centroid to be expected. Expected and found centroids are "
        f"{fixed(float(np.median(apart)), 3)} px apart (median), at most {fixed(max(apart), 3)} px."
    )
    caption = "Centroids: matched, expected and found"
    return [Paragraph(text), shown(rows, caption, head, wide=True)]


def _pictures(
    matches: Correspondences,
    scene: ScenePictures,
    place: FloatArray,
    kept: BoolArray,
    axis: int,
) -> list[Block]:
    found = [(scene.view(name), column) for column, name in enumerate(matches.cameras)]
    pairs = [(view, column) for view, column in found if view is not None]
    views: list[ViewPicture] = [view for view, _ in pairs]
    if not views:
        return []
    marks = [matches.xy_px[:, column] for _, column in pairs]
    blocks: list[Block] = []
    if scene.element is not None:
        element = scene.element
        axis_name, offset = element.plane
        caption = (
            f"How a structuring element finds point {element.point}: the edge pixels around it are "
            f"carried into the second view through the plane {axis_name} = {fixed(offset, 1)} mm "
            "and moved along the epipolar segment. Where the fewest of them are missing is its "
            "match."
        )
        if scene.method != "literal":
            caption += (
                " The program's matcher finds places by oriented edges and their neighbours, to a "
                "fraction of a pixel."
            )
        blocks.append(Figure(draw_element(element).render(), caption))
    if kept.any():
        name = "XYZ"[axis]
        drawing = draw_depths(views, [xy[kept] for xy in marks], place[kept, axis], name)
        caption = (
            f"Kept matches on all views, coloured by {name}; the outermost hundredth at either end "
            "has the colour of the end."
        )
        blocks.append(Figure(drawing.render(), caption))
    if not matches.point_flags.any():
        return blocks
    caption = (
        "All points, coloured by flag; where one carries several, by the rarest. In the further "
        "views a flagged point stands where the matcher would place it."
    )
    flags = draw_flags(views, marks, matches.point_flags)
    blocks.append(Figure(flags.render(), caption))
    return blocks


def _strengths(views: Sequence[ViewPicture]) -> Figure:
    return Figure(
        draw_strengths(views).render(),
        "Edge strength of the images by the blur-minimum operator; a pixel above Trussell's "
        "threshold is an edge pixel.",
    )


def _wire(
    matches: Correspondences, place: FloatArray, kept: BoolArray, axis: int, rig: Rig
) -> Figure:
    """Draw the kept points in space."""
    xyz = place[kept]
    names = [name for name, use in zip(matches.point, kept, strict=True) if use]
    label = f"{'XYZ'[axis]} [mm]"
    canvas = draw_wire(
        xyz,
        neighbours(names, xyz),
        xyz[:, axis],
        volume_mm=rig.volume_mm,
        up=paper_up(rig.cameras, rig.volume_mm),
        limits=depth_limits(xyz[:, axis]),
        label=label,
    )
    low, high = (mm(float(value)) for value in (xyz[:, axis].min(), xyz[:, axis].max()))
    caption = (
        f"{counted(len(xyz), 'kept point')} in space, neighbours on an edge joined; {label[0]} "
        f"from {low} to {high} mm. Box: the calibrated measuring volume; axes in mm."
    )
    return Figure(canvas.render(), caption)
