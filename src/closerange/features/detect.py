"""Finding a whole target in one image: pixels become rows of the points table."""

from __future__ import annotations

import warnings

import cv2
import numpy as np

from closerange.errors import CloseRangeWarning, DetectionError
from closerange.features.chessboard import Corners, find_charuco, find_chessboard
from closerange.features.disc_grid import label_discs
from closerange.features.discs import Discs, find_discs, saturation_level
from closerange.features.image_points import ImagePoints
from closerange.features.target import Charuco, Chessboard, DiscGrid, Target
from closerange.features.threshold import ThresholdReport
from closerange.flags import Flag
from closerange.geometry.arrays import IntArray
from closerange.images.frame import Frame

SATURATED_SHARE = 0.01
"""Share of a target's pixels at full scale above which none of its points is relied upon:
clipped grey values shift edges towards the dark side."""

DISC_RIM = 1.2
"""A disc's pixels reach this many radii out: its edge belongs to it, on both sides."""


def detect_target(
    frame: Frame,
    target: Target,
    *,
    placement: str = "",
    reading: str = "",
    estimator: str = "least-squares",
) -> ImagePoints:
    """Find a target in one image.

    Parameters
    ----------
    frame : Frame
        The image; its camera names the rows.
    target : Target
        What to look for.
    placement, reading : str, optional
        Names of the state of the world and of the repeated measurement.
    estimator : str, optional
        How disc centres are measured; see `find_discs`. Other kinds ignore it.

    Returns
    -------
    ImagePoints
        All points of the target in its order; NaN and flag not_found (at_border for a disc
        cut by the image border) where one is not seen.

    Raises
    ------
    DetectionError
        If the target is not, or not unambiguously, in the image, or has no pattern.

    Warns
    -----
    CloseRangeWarning
        If points are blurred, cut by the border, or more than 1 % of the target's pixels are
        saturated (then all rows carry the flag).
    """
    where = frame.source or f"image of camera {frame.camera!r}"
    points, report = _find(frame, target, estimator, where)
    flags = _with_saturation(frame, points, where)
    _warn_of_defects(flags, where)
    return ImagePoints.of(
        camera=frame.camera,
        placement=placement,
        reading=reading,
        point=target.point,
        xy_px=points.xy_px,
        cov_px2=points.cov_px2,
        flags=flags,
        ellipse=points.ellipse,
        disc_diameter_mm=target.diameters_mm,
        size_px={frame.camera: frame.size_px},
        noise_cov_px2=points.noise_cov_px2,
        thresholds={(frame.camera, placement, reading): report} if report else None,
    )


def _find(
    frame: Frame, target: Target, estimator: str, where: str
) -> tuple[ImagePoints, ThresholdReport | None]:
    """Find the target's points by its kind, with a disc grid's threshold; errors name the image."""
    pattern = target.pattern
    if pattern is None:
        raise DetectionError(
            'a target of kind "points" has no pattern that could be found in an image',
            remedy="write its image points into a points table and calibrate with that",
        )
    try:
        if isinstance(pattern, DiscGrid):
            return _discs(frame, target, pattern, estimator)
        return _corners(frame, target, pattern), None
    except DetectionError as error:
        message = error.message if where in error.message else f"{where}: {error.message}"
        raise DetectionError(message, remedy=error.remedy) from error


def _corners(frame: Frame, target: Target, pattern: Chessboard | Charuco) -> ImagePoints:
    corners: Corners
    if isinstance(pattern, Charuco):
        corners = find_charuco(frame, pattern)
    else:
        corners = find_chessboard(frame, pattern)
    return ImagePoints.of(
        camera=frame.camera,
        point=target.point,
        xy_px=corners.xy_px,
        cov_px2=corners.cov_px2,
        flags=corners.flags,
    )


def _discs(
    frame: Frame, target: Target, grid: DiscGrid, estimator: str
) -> tuple[ImagePoints, ThresholdReport]:
    """Find, label and put in order the discs of a grid."""
    found = find_discs(frame, polarity=grid.polarity, estimator=estimator)
    index = _label(found, grid)
    seen = index >= 0
    rows = index[seen]
    xy, ellipse = np.full((len(target), 2), np.nan), np.full((len(target), 3), np.nan)
    cov, noise = np.full((2, len(target), 2, 2), np.nan)
    flags = np.where(seen, 0, int(Flag.not_found))
    xy[seen], ellipse[seen] = found.xy_px[rows], found.ellipse[rows]
    cov[seen], noise[seen] = found.cov_px2[rows], found.noise_cov_px2[rows]
    flags[seen] |= found.flags[rows]
    # a cut disc helps to name the others, but its own centre is biased
    cut = (flags & Flag.at_border) != 0
    for array in (xy, ellipse, cov, noise):
        array[cut] = np.nan
    points = ImagePoints.of(
        camera=frame.camera,
        point=target.point,
        xy_px=xy,
        cov_px2=cov,
        flags=flags,
        ellipse=ellipse,
        noise_cov_px2=noise,
    )
    return points, found.thresholds


def _label(found: Discs, grid: DiscGrid) -> IntArray:
    """Label with the discs cut by the border if that succeeds, else without them."""
    whole = np.flatnonzero((found.flags & Flag.at_border) == 0)
    if len(whole) == len(found.xy_px):
        return label_discs(found.xy_px, found.ellipse, grid)
    try:
        return label_discs(found.xy_px, found.ellipse, grid)
    except DetectionError as error:
        try:
            index = label_discs(found.xy_px[whole], found.ellipse[whole], grid)
        except DetectionError:
            raise error from None
        return np.where(index >= 0, whole[index], -1)


def _with_saturation(frame: Frame, points: ImagePoints, where: str) -> IntArray:
    """Return the rows' flags; all found rows saturated where the target is."""
    flags = points.flags.copy()
    share = _saturated_share(frame, points)
    if share > SATURATED_SHARE:
        flags[points.found] |= int(Flag.saturated)
        warnings.warn(
            f"{where}: {share:.1%} of the target's pixels are saturated, the limit is "
            f"{SATURATED_SHARE:.0%}; shorten the exposure",
            CloseRangeWarning,
            stacklevel=3,
        )
    return flags


def _saturated_share(frame: Frame, points: ImagePoints) -> float:
    """Return the share at full scale of the discs' pixels, or of the area between corners."""
    mask = np.zeros(frame.pixels.shape, np.uint8)
    xy = points.xy_px[points.found]
    ellipse = points.ellipse[points.found]
    if np.isfinite(ellipse).all():
        for (x, y), (a, b, angle) in zip(xy, ellipse, strict=True):
            axes = (float(2 * DISC_RIM * a), float(2 * DISC_RIM * b))
            cv2.ellipse(mask, ((float(x), float(y)), axes, float(np.degrees(angle))), 1, -1)
    else:
        hull = cv2.convexHull(xy.astype(np.float32)).reshape(-1, 2)
        cv2.fillConvexPoly(mask, np.rint(hull).astype(np.int32), 1)
    inside = frame.pixels[mask > 0]
    return float((inside >= saturation_level(frame)).mean()) if inside.size else 0.0


def _warn_of_defects(flags: IntArray, where: str) -> None:
    """Warn once of each defect that the user could mend by taking the image again."""
    for flag, what in (
        (Flag.blurred, "are blurred; focus the lens"),
        (Flag.at_border, "are cut by the image border; move the target inwards"),
    ):
        count = int(np.count_nonzero(flags & flag))
        if count:
            text = f"{where}: {count} of {len(flags)} points {what}"
            warnings.warn(text, CloseRangeWarning, stacklevel=3)
