"""The methods that are measured, each behind the same interface."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from closerange.flags import Flag
from closerange.rig.camera import Camera
from matching.method import BoolArray, FloatArray, Images, Matches, Method, UnavailableError
from matching.peers import semi_global, sift, zncc_sweep

OURS = "closerange"
REJECTED = 1
"""Flag of a peer's own check: peers do not say why."""

LOST = int(Flag.no_edge | Flag.not_found | Flag.occluded | Flag.inconsistent)
"""Flags of having no match and of the left-right check."""


@dataclass(frozen=True, slots=True)
class Peer:
    """A method of `matching.peers`; what its own check rejects is flagged."""

    name: str
    find: Callable[..., tuple[FloatArray, BoolArray]]

    def match(
        self,
        images: Images,
        cameras: Sequence[Camera],
        points_px: FloatArray,
        volume_mm: FloatArray,
    ) -> Matches:
        """Find points of the first view in the second."""
        found, kept = self.find(images, cameras, points_px, volume_mm)
        return Matches(found, np.where(kept, 0, REJECTED), kept)


@dataclass(frozen=True, slots=True)
class Default:
    """The program's matcher, with two views or with all there are."""

    name: str = OURS
    all_views: bool = False

    def match(
        self,
        images: Images,
        cameras: Sequence[Camera],
        points_px: FloatArray,
        volume_mm: FloatArray,
    ) -> Matches:
        """Find points of the first view in the second."""
        matcher = _module("matcher", "match_views", "views_of")
        count = len(images) if self.all_views else 2
        if self.all_views and count < 3:
            raise UnavailableError("this scene has two views")
        views = matcher.views_of(cameras[:count], images[:count])
        # without covariances of the seeds the matches' hold all uncertainty, which is what an
        # error against the surface point on the seed's own ray is to be compared with
        found = matcher.match_views(views, volume_mm, seeds_px=points_px)
        flags = np.asarray(found.flags[:, 1], np.int64)
        return Matches(
            np.array(found.xy_px[:, 1]),
            flags,
            (flags & LOST) == 0,
            np.array(found.cov_px2[:, 1]),
        )


@dataclass(frozen=True, slots=True)
class Literal:
    """The thesis' matcher, with a square structuring element."""

    name: str
    side_px: int

    def match(
        self,
        images: Images,
        cameras: Sequence[Camera],
        points_px: FloatArray,
        volume_mm: FloatArray,
    ) -> Matches:
        """Find points of the first view in the second; back again for the left-right check."""
        literal = _module("literal", "match_literal")
        start = time.perf_counter()
        there = literal.match_literal(
            images[:2], cameras[:2], points_px, volume_mm, side_px=self.side_px
        )
        one_way = time.perf_counter() - start
        found = np.array(there.xy_px)
        known = np.isfinite(found).all(axis=1)
        back = np.full_like(found, np.nan)
        if known.any():
            back[known] = literal.match_literal(
                images[1::-1], cameras[1::-1], found[known], volume_mm, side_px=self.side_px
            ).xy_px
        with np.errstate(invalid="ignore"):
            returns = np.linalg.norm(back - points_px, axis=1) < zncc_sweep.RETURN_PX
        flags = np.where(returns, there.flags, int(Flag.inconsistent))
        return Matches(found, flags.astype(np.int64), returns, one_way_s=one_way)


def methods(names: Sequence[str] = ()) -> list[Method]:
    """Return all methods, or those whose name contains one of the given words."""
    every: list[Method] = [
        Default(),
        Default(f"{OURS}, all views", all_views=True),
        Literal("thesis, literal 15 x 15", 15),
        Literal("thesis, literal 59 x 59", 59),
        Peer("plane-swept ZNCC 15 x 15", zncc_sweep.match),
        Peer("OpenCV SGBM-HH, rectified", semi_global.match),
        Peer("SIFT, ratio + epipolar", sift.match),
    ]
    wanted = [name.lower() for name in names]
    return [m for m in every if not wanted or any(word in m.name.lower() for word in wanted)]


def _module(name: str, *needed: str) -> Any:
    """Import a module of the matching room, or say that it is missing."""
    from importlib import import_module  # noqa: PLC0415  # only methods that are measured are loaded

    try:
        module = import_module(f"closerange.matching.{name}")
    except ImportError as error:
        raise UnavailableError(f"closerange.matching.{name} cannot be imported: {error}") from error
    for attribute in needed:
        if not hasattr(module, attribute):
            raise UnavailableError(f"closerange.matching.{name} has no {attribute}")
    return module
