"""Pictures of a run: images of the calibration and of each job with what was found on them."""

from __future__ import annotations

from dataclasses import replace

from closerange.delivery.overlays import Overlay, make_overlay
from closerange.features.image_points import ImagePoints
from closerange.images import natural_key, placement_and_reading, read_image
from closerange.rig.rig import Rig
from closerange.settings import Detection, Settings, images_of, inside
from closerange.workflows.detect import read_crops

MAX_OVERLAYS = 20
"""Pictures of the calibration in a report: of more images the first ones are shown."""

JOB_OVERLAYS = 2
"""Pictures of each camera and job: enough to see what was measured, and how well it was seen."""


def overlays_of(
    settings: Settings,
    detection: Detection,
    points: ImagePoints,
    rig: Rig | None,
    *,
    most: int,
) -> list[Overlay]:
    """Draw on at most so many images, the same number of each camera.

    Parameters
    ----------
    settings : Settings
        The project.
    detection : Detection
        Its calibration, or a job.
    points : ImagePoints
        What was found.
    rig : Rig or None
        With it, the residuals of the calibration are drawn as well.
    most : int
        Pictures.

    Returns
    -------
    list of Overlay
        Of the first placements; of repeated readings, whose pictures look alike, the first.
    """
    each = max(1, most // len(detection.images))
    crops = None if detection.crops is None else read_crops(inside(settings, detection.crops))
    overlays = []
    for camera, patterns in detection.images.items():
        paths = sorted(images_of(settings, patterns), key=lambda file: natural_key(file.name))
        named = [
            (path, *placement_and_reading(path, detection.placement_pattern)) for path in paths
        ]
        # of repeated readings, whose pictures look alike, the first
        firsts = {placement: (path, reading) for path, placement, reading in reversed(named)}
        for placement in list(dict.fromkeys(placement for _, placement, _ in named))[:each]:
            path, reading = firsts[placement]
            frame = read_image(path, camera=camera)
            overlay = make_overlay(
                replace(frame, source=path.relative_to(settings.folder).as_posix()),
                points,
                placement=placement,
                reading=reading,
                residuals=None if rig is None else rig.residuals,
            )
            if crops is not None:
                overlay = replace(overlay, xy_px=overlay.xy_px - crops[path.name])
            overlays.append(overlay)
    return overlays
