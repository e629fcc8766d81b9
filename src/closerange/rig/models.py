"""Named sets of camera parameters that a calibration may free."""

from __future__ import annotations

from dataclasses import dataclass

from closerange.errors import InputError
from closerange.rig.camera import POSE
from closerange.rig.distortion import COEFFICIENTS, INTRINSICS

_PINHOLE = ("fx", "fy", "cx", "cy")

FREE: dict[str, tuple[str, ...]] = {
    "pinhole": (*_PINHOLE, *POSE),
    "brown-k1": (*_PINHOLE, "k1", *POSE),
    "brown-k1k2": (*_PINHOLE, "k1", "k2", *POSE),
    "brown": (*_PINHOLE, "k1", "k2", "p1", "p2", *POSE),
    "brown-k3": (*_PINHOLE, "k1", "k2", "p1", "p2", "k3", *POSE),
    "brown-skew": (*_PINHOLE, "skew", "k1", "k2", "p1", "p2", *POSE),
}
"""Free parameters of the models that are fitted by least squares in the image."""

LINEAR = ("dlt", "thesis-dlt", "thesis-distortion")
"""Models solved by methods of their own and turned into cameras afterwards."""

MODELS = ("auto", *FREE, *LINEAR)

SPARE = 1.5
"""Numbers per parameter that the automatic choice asks for: with fewer, single points carry whole
parameters and neither a blunder nor a wrong model shows. Ten parameters then need eight points."""

_WHY_FIXED = {
    "skew": "0: the rows and columns of digital sensors are square to each other",
    "k1": "0: no radial distortion in this model",
    "k2": "0: no second radial term in this model",
    "k3": "0: a needless k3 costs 11-14 % in calibration error at 27 points; only wide lenses "
    "need it",
    "p1": "0: no decentring in this model",
    "p2": "0: no decentring in this model",
}


@dataclass(frozen=True, slots=True)
class Model:
    """A named set of parameters.

    Attributes
    ----------
    name : str
        As in ``--model``.
    free : tuple of str
        Estimated parameters of each camera, as `Camera.parameter_jacobian` names them.
    """

    name: str
    free: tuple[str, ...]

    @property
    def fixed(self) -> dict[str, str]:
        """Parameters that are not estimated, each with its value and why."""
        every = (*INTRINSICS, *COEFFICIENTS)
        return {name: _WHY_FIXED[name] for name in every if name not in self.free}

    def affordable(self, points: int) -> bool:
        """Whether the automatic choice may take it with this many points in a camera."""
        return 2 * points >= SPARE * len(self.free)


def model_named(name: str) -> Model:
    """Return a model.

    Parameters
    ----------
    name : str
        Of `FREE` or `LINEAR`; ``auto`` is not a model but a choice among them.

    Returns
    -------
    Model
        A linear model lists the parameters of the camera it is turned into.

    Raises
    ------
    InputError
        If there is no such model; the message lists those there are.
    """
    if name in FREE:
        return Model(name, FREE[name])
    if name in ("dlt", "thesis-dlt"):
        return Model(name, (*_PINHOLE, "skew", *POSE))
    if name == "thesis-distortion":
        return Model(name, (*_PINHOLE, "skew", "k1", "k2", "k3", "p1", "p2", *POSE))
    raise InputError(
        f"model {name!r} is not known; there are {', '.join(MODELS)}",
        remedy="choose one of them; auto is the default",
    )
