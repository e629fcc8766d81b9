"""SIFT on its own points: how many matches there are and how many of them are right."""

from __future__ import annotations

import numpy as np

from matching.peers.sift import keypoint_matches
from matching.scene_truth import Kind
from matching.scenes import Scene


def keypoint_summary(scene: Scene) -> str:
    """Say it in one sentence."""
    first, second = keypoint_matches(scene.images, scene.cameras, scene.volume_mm)
    text = f"SIFT at its own points: {len(first)} matches after both filters"
    if scene.of_points is None or not len(first):
        return text + "."
    truth = scene.of_points(first)
    known = np.isin(truth.kind, [int(Kind.edge), int(Kind.surface), int(Kind.occluded)])
    error = np.linalg.norm(second - truth.xy_px, axis=1)
    right = known & (truth.kind != int(Kind.occluded)) & (error < scene.right_px)
    return (
        f"{text}, {int(known.sum())} of them on surfaces with truth; of these {int(right.sum())} "
        f"are right within {scene.right_px:g} px."
    )
