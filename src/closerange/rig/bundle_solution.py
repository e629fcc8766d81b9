"""A bundle settled: placements sorted, blunders left out, weights and disc centres corrected."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from closerange.errors import CloseRangeWarning, GeometryError
from closerange.geometry.arrays import BoolArray, FloatArray, IntArray
from closerange.rig.bundle import Bundle, BundleFit, Sightings
from closerange.rig.bundle_outliers import fit_bundle_without_blunders
from closerange.rig.bundle_start import MIN_POINTS, posed, start_bundle
from closerange.rig.models import Model
from closerange.rig.observations import Observations, listed, without_disc_bias
from closerange.rig.outliers import MAX_SHARE, ROUNDING_PX
from closerange.rig.solution import ROUNDS, SETTLED
from closerange.rig.weights import common_variance, pull_of, shared_errors, whitener_of


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Joined points whose placements can be posed; N rows.

    Attributes
    ----------
    observations : Observations
        Points with their positions in the target's frame.
    placements : tuple of str
        Names; the first is the world.
    placement : ndarray of int, shape (N,)
        Index into `placements`.
    """

    observations: Observations
    placements: tuple[str, ...]
    placement: IntArray

    def sightings(self, xy_px: FloatArray) -> Sightings:
        """Return the usable rows, with given image positions of all rows."""
        rows = self.observations.usable
        return Sightings(
            self.observations.camera[rows],
            self.placement[rows],
            self.observations.xyz_mm[rows],
            xy_px[rows],
        )

    def in_world(self, bundle: Bundle) -> Observations:
        """Return the points in the world; no two placements share a control position there."""
        return replace(
            self.observations,
            xyz_mm=bundle.world_mm(self.placement, self.observations.xyz_mm),
            control_row=np.arange(len(self.observations), dtype=np.int64),
        )


@dataclass(frozen=True, slots=True, eq=False)
class BundleSolution:
    """An adjusted bundle with settled weights; N rows, n of them usable.

    Attributes
    ----------
    fit : BundleFit
        Of the points kept.
    placed : Placed
        The points.
    xy_px : ndarray, shape (N, 2)
        Image positions, corrected for the bias of discs.
    seen : Sightings
        Usable rows with their weights.
    used : ndarray of bool, shape (n,)
        Usable rows that took part.
    tau_px : float
        Common part of the points' standard deviation.
    weighted : bool
        Whether residuals were weighed by covariances.
    """

    fit: BundleFit
    placed: Placed
    xy_px: FloatArray
    seen: Sightings
    used: BoolArray
    tau_px: float
    weighted: bool

    @property
    def kept(self) -> BoolArray:
        """Rows that took part, shape (N,)."""
        kept = self.placed.observations.usable.copy()
        kept[kept] = self.used
        return kept

    @property
    def noise_px(self) -> float:
        """S with s^2 = RSS / (n - p); of exact data what rounding could hide, never 0."""
        return max(float(np.sqrt(self.fit.rss_px2 / self.fit.dof)), ROUNDING_PX)

    def covariance(self) -> FloatArray:
        """Return the covariance of the cameras' parameters, shape (P, P).

        A point's error on the target goes with it into all placements and images, where the
        parameters take up most of it: what the residuals show of it tells too little to be taken
        off them. It therefore counts as image noise too, which errs on the safe side.
        """
        fit, bundle, observations = self.fit, self.fit.bundle, self.placed.observations
        total = (1.0 if self.weighted else self.noise_px**2) * fit.cofactor
        std = observations.std_mm[self.kept]
        if std.any():
            seen = self.seen.select(self.used)
            turns = np.stack([pose.rotation for pose in bundle.poses])[seen.placement]
            by_point = bundle.by_world(seen) @ turns * std[:, None, None]
            pull = pull_of(fit, seen.whitener, by_point)
            total = total + shared_errors(pull, observations.control_row[self.kept])
        count = bundle.camera_count
        symmetric: FloatArray = 0.5 * (total + total.T)[:count, :count]
        return symmetric


def place(observations: Observations) -> Placed:
    """Index the placements and leave out those of which no camera sees enough points.

    Parameters
    ----------
    observations : Observations
        Joined points, in the target's frame.

    Returns
    -------
    Placed
        Rows of the placements that can be posed.

    Raises
    ------
    GeometryError
        If there is none.

    Warns
    -----
    CloseRangeWarning
        Of placements that are left out.
    """
    names = observations.points.placement
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    placement = np.array([number[name] for name in names], dtype=np.int64)
    placed = Placed(observations, tuple(number), placement)
    seen = placed.sightings(observations.points.xy_px)
    found = {i for camera in range(len(observations.cameras)) for i in posed(seen, camera)}
    lost = [name for name, i in number.items() if i not in found]
    if not lost:
        return placed
    if not found:
        raise GeometryError(
            f"no camera sees {MIN_POINTS} usable points of any placement",
            remedy="hold the target so that more of it is seen, and name its placements",
        )
    warnings.warn(
        f"placements {listed(lost)} are left out: no camera sees {MIN_POINTS} points of them",
        CloseRangeWarning,
        stacklevel=3,
    )
    return place(observations.select(np.isin(placement, sorted(found))))


def solve_bundle(placed: Placed, model: Model) -> BundleSolution:
    """Adjust cameras and placements, correct the centres of discs, and adjust again.

    Parameters
    ----------
    placed : Placed
        Points.
    model : Model
        What to estimate of each camera.

    Returns
    -------
    BundleSolution
        Without blunders, with settled weights.

    Raises
    ------
    GeometryError
        If the placements cannot carry the parameters, or most points of an image contradict the
        others.
    """
    observations, xy = placed.observations, placed.observations.points.xy_px
    start = start_bundle(placed.sightings(xy), observations.size_px, model.free)
    solution = _settle(placed, xy, start)
    bundle = solution.fit.bundle
    corrected = without_disc_bias(placed.in_world(bundle), bundle.cameras)
    if (corrected != xy).any():
        solution = _settle(placed, corrected, bundle)
    _require_agreement(solution)
    return solution


def _settle(placed: Placed, xy_px: FloatArray, start: Bundle) -> BundleSolution:
    """Settle blunders and weights together, as `solution.solve` does."""
    observations, bundle, seen = placed.observations, start, placed.sightings(xy_px)
    cov = np.empty((len(observations), 2, 2))
    for i in range(len(observations.cameras)):
        cov[observations.rows(i)] = observations.stated_cov(i)
    cov = cov[observations.usable]
    weighted, tau2 = bool(cov.any()), -1.0
    for _ in range(ROUNDS):
        fit, used = fit_bundle_without_blunders(seen, bundle, trials=len(observations))
        bundle = fit.bundle
        last, tau2 = tau2, common_variance(fit.residual_px, cov[used], fit.dof)
        if not weighted or (last >= 0 and abs(tau2 - last) <= SETTLED * last):
            break
        seen = seen.weighted(whitener_of(cov + max(tau2, ROUNDING_PX**2) * np.eye(2)))
    return BundleSolution(fit, placed, xy_px, seen, used, float(np.sqrt(tau2)), weighted)


def _require_agreement(solution: BundleSolution) -> None:
    """Refuse an image whose points mostly contradict the others: blunders do not gather so."""
    seen, placed = solution.seen, solution.placed
    image = seen.camera * len(placed.placements) + seen.placement
    count = np.bincount(image)
    out = np.bincount(image[~solution.used], minlength=len(count))
    for number in np.flatnonzero(out > MAX_SHARE * count):
        camera, placement = divmod(int(number), len(placed.placements))
        raise GeometryError(
            f"camera {placed.observations.cameras[camera]!r}, placement "
            f"{placed.placements[placement]!r}: {out[number]} of {count[number]} points contradict "
            "those of the other images",
            remedy="are the points of one image of this placement named in another order, did the "
            "target move between the exposures of the cameras, or is it another placement's image? "
            "Correct it or leave the placement out",
        )
