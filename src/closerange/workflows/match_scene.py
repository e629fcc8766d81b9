"""A job of a project that matches: one scene, its points, positions, comparison and pictures."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from closerange.delivery.match_pictures import ScenePictures, scene_pictures
from closerange.errors import CloseRangeWarning, DetectionError, FileError
from closerange.features.image_points import ImagePoints
from closerange.features.patches import Patches, area_centroid, find_patches
from closerange.geometry.arrays import FloatArray, all_finite
from closerange.images import Frame
from closerange.matching.common_view import mean_direction
from closerange.matching.correspondences import Correspondences
from closerange.matching.search import plane_mapping
from closerange.position.positions import Positions
from closerange.rig.rig import Rig
from closerange.settings import MatchJob, Settings, images_of, inside
from closerange.workflows.match import Matched, match_images
from closerange.workflows.match_inputs import LITERAL_PX, Wanted, read_frames
from closerange.workflows.measure import measure


@dataclass(frozen=True, slots=True, eq=False)
class MatchedScene:
    """What a job that matches gave.

    Attributes
    ----------
    matches : Correspondences
        Points, the reference camera first.
    positions : Positions
        Their positions.
    pictures : ScenePictures
        For the report.
    elapsed_s : float
        The program's own time, from the images on disk to the positions.
    """

    matches: Correspondences
    positions: Positions
    pictures: ScenePictures
    elapsed_s: float


def match_scene(
    settings: Settings, job: MatchJob, rig: Rig, *, progress: Callable[[int, int], None]
) -> MatchedScene:
    """Match and measure the scene of a job.

    Parameters
    ----------
    settings : Settings
        The project.
    job : MatchJob
        Its job.
    rig : Rig
        The calibrated cameras.
    progress : callable
        Called with (done, total) after each pair of cameras.

    Returns
    -------
    MatchedScene
        Matches, positions and pictures.

    Raises
    ------
    CloseRangeError
        As `closerange.match` and `closerange.measure`.

    Warns
    -----
    CloseRangeWarning
        If the images do not seem to be those of the cameras.
    """
    start = time.perf_counter()
    frames = read_frames(rig, _one_image_each(settings, job))
    seeds = _seeds(settings, job, frames)
    wanted = Wanted(
        points=seeds,
        edges=job.match == "edges",
        corners=job.match == "corners",
        z_mm=None if job.z_mm is None else (job.z_mm[0], job.z_mm[1]),
        volume_mm=job.volume_mm,
        method=job.method,
        element_px=job.element_px,
    )
    matched = match_images(rig, frames, wanted, progress=progress)
    if matched.doubt:
        text = f"job {job.name!r}: {matched.doubt}; all its matches are flagged"
        warnings.warn(text, CloseRangeWarning, stacklevel=2)
    positions = measure(rig, matched.matches)
    elapsed_s = time.perf_counter() - start
    own = [_named(frame, settings) for frame in frames.values()]
    centroids = _compare(rig, frames, matched, positions) if job.match == "centroids" else ()
    literal = job.method == "literal"
    pictures = scene_pictures(
        rig,
        own,
        matched.matches,
        matched.volume_mm,
        method=job.method,
        element_px=(job.element_px or LITERAL_PX) if literal else None,
        centroids=centroids,
    )
    return MatchedScene(matched.matches, positions, pictures, elapsed_s)


def centroids_of(frame: Frame) -> ImagePoints:
    """Find the centroids of bright faces in an image, as points to be matched.

    Parameters
    ----------
    frame : Frame
        The image.

    Returns
    -------
    ImagePoints
        ``face1``, ``face2``, ... from the largest face to the smallest.

    Raises
    ------
    DetectionError
        If there is none.
    """
    patches = find_patches(frame.pixels)
    if not len(patches):
        raise DetectionError(
            f"the image of camera {frame.camera!r} has no bright face",
            remedy="faces must be brighter than what surrounds them; match edges, or give points",
        )
    names = [f"face{number}" for number in range(1, len(patches) + 1)]
    return ImagePoints.of(camera=frame.camera, point=names, xy_px=patches.xy_px)


def _one_image_each(settings: Settings, job: MatchJob) -> dict[str, Path]:
    """Find the one image of each camera."""
    found = {}
    for camera, patterns in job.images.items():
        paths = images_of(settings, patterns)
        if len(paths) != 1:
            raise FileError(
                f"job {job.name!r}: {len(paths)} images of camera {camera!r}; a scene that is "
                "matched has one of each",
                remedy="name one file, or write one job for each scene",
            )
        found[camera] = paths[0]
    return found


def _seeds(
    settings: Settings, job: MatchJob, frames: Mapping[str, Frame]
) -> ImagePoints | Path | None:
    if job.match == "centroids":
        return centroids_of(next(iter(frames.values())))
    return None if job.points is None else inside(settings, job.points)


def _named(frame: Frame, settings: Settings) -> Frame:
    """Name an image by its path in the project: the folders above belong to the machine."""
    path = Path(frame.source)
    if path.is_relative_to(settings.folder):
        path = path.relative_to(settings.folder)
    return Frame(frame.camera, frame.pixels, frame.time_s, path.as_posix())


def _compare(
    rig: Rig, frames: Mapping[str, Frame], matched: Matched, positions: Positions
) -> Sequence[Mapping[str, Any]]:
    """Compare matched centroids with those found in the second view (Table 5.3)."""
    matches = matched.matches
    here, away = (rig.camera(name) for name in matches.cameras[:2])
    first, second = (find_patches(frames[camera.name].pixels) for camera in (here, away))
    axis = int(np.argmax(np.abs(mean_direction([here, away]))))
    place = dict(zip(positions.keys(), positions.xyz_mm, strict=True))
    entries = []
    for row, key in enumerate(matches.keys()):
        seed, match = matches.xy_px[row, 0], matches.xy_px[row, 1]
        if not (all_finite(match, 0) and np.isfinite(place[key]).all()) or not len(second):
            continue
        line = first.outline_px[_nearest(first, seed)]
        normal, offset = np.eye(3)[axis], float(place[key][axis])
        both = np.concatenate([line, seed[None]])
        there = plane_mapping(here, away, both, normal=normal, offset_mm=offset).xy_px
        if not all_finite(there, (0, 1)):
            continue
        # what perspective does to the face's centroid, added to the match itself
        expected = match + area_centroid(there[:-1])[1] - there[-1]
        found = second.xy_px[_nearest(second, expected)]
        entries.append(
            {
                "point": matches.point[row],
                "seed_px": seed.tolist(),
                "match_px": match.tolist(),
                "expected_px": expected.tolist(),
                "found_px": found.tolist(),
            }
        )
    return entries


def _nearest(patches: Patches, xy_px: FloatArray) -> int:
    return int(np.argmin(np.linalg.norm(patches.xy_px - xy_px, axis=1)))
