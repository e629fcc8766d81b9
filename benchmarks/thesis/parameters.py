"""Figure 2.4: the eleven parameters of both cameras, taken apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import rq

from thesis.tables import FloatArray, Lines, fixed, markdown, read_json

# (camera, element from 0, literal reading): the two numbers whose decimal point is doubtful
DOUBTFUL = {"camera1": (8, "a9"), "camera2": (4, "a5")}


@dataclass(frozen=True, slots=True, eq=False)
class Decomposed:
    """A projection matrix as a camera; image axes as in the source (y up)."""

    centre_mm: FloatArray
    fx_px: float
    fy_px: float
    skew_px: float
    principal_px: FloatArray

    @property
    def skew_deg(self) -> float:
        """Departure of the pixel axes from a right angle."""
        return float(np.degrees(np.arctan2(self.skew_px, self.fx_px)))


def projection_matrix(parameters: list[float]) -> FloatArray:
    """Put a1 to a11 and a12 = 1 into a 3 x 4 matrix (eq. 2.1)."""
    return np.array([*parameters, 1.0]).reshape(3, 4)


def decompose(matrix: FloatArray) -> Decomposed:
    """Split P = K [R | t] with a positive diagonal of K."""
    upper, _ = rq(matrix[:, :3])
    upper = upper @ np.diag(np.sign(np.diag(upper)))
    upper /= upper[2, 2]
    return Decomposed(
        centre_mm=-np.linalg.solve(matrix[:, :3], matrix[:, 3]),
        fx_px=float(upper[0, 0]),
        fy_px=float(upper[1, 1]),
        skew_px=float(upper[0, 1]),
        principal_px=upper[:2, 2],
    )


def block() -> FloatArray:
    """Return the 27 calibration points of Figure 2.7, shape (27, 3), mm."""
    grid = np.meshgrid([-6.35, 0.0, 6.35], [-6.35, 0.0, 6.35], [-7.62, 0.0, 7.62])
    return np.column_stack([axis.ravel() for axis in grid])


def project(matrix: FloatArray, xyz_mm: FloatArray) -> FloatArray:
    """Project world points, shape (N, 2), px from the image centre."""
    homogeneous = np.column_stack([xyz_mm, np.ones(len(xyz_mm))]) @ matrix.T
    pixels: FloatArray = homogeneous[:, :2] / homogeneous[:, 2:]
    return pixels


def readings() -> dict[str, FloatArray]:
    """Projection matrices of both cameras in both readings."""
    source = read_json("fig_2_4_calibration_parameters.json")
    found = {}
    for camera, (index, element) in DOUBTFUL.items():
        alternative = next(
            repair["alternative_literal"]
            for repair in source["repairs"]
            if repair["element"] == element and f"camera{repair['camera']}" == camera
        )
        literal = list(source[camera])
        literal[index] = alternative
        found[f"{camera} as repaired"] = projection_matrix(source[camera])
        found[f"{camera}, {element} read literally"] = projection_matrix(literal)
    return found


CAMERA_HEADER = (
    "reading",
    "centre X, Y, Z in mm",
    "fx, px",
    "fy, px",
    "skew, deg",
    "principal point from image centre, px",
)


def parameters_section() -> Lines:
    """Decomposition of both readings and how far they lie apart in the image."""
    found = readings()
    rows = [_camera_row(name, decompose(matrix)) for name, matrix in found.items()]
    names = list(found)
    apart = []
    for repaired, literal in (names[:2], names[2:]):
        gap = project(found[repaired], block()) - project(found[literal], block())
        distance = np.hypot(*gap.T)
        apart.append(
            [literal, fixed(float(np.sqrt(np.mean(distance**2))), 2), fixed(distance.max(), 2)]
        )
    left, right = (decompose(found[name]).centre_mm for name in (names[0], names[2]))
    baseline = float(np.linalg.norm(left - right))
    return [
        "### Parameters of Figure 2.4",
        "",
        (
            "The eleven numbers of each camera as a camera: projection centre, focal lengths, skew "
            "and principal point. The microfilm lost some decimal points; for one number of each "
            "camera two readings are possible, and both are shown."
        ),
        *markdown(
            CAMERA_HEADER,
            rows,
        ),
        (
            f"As repaired, the cameras stand {fixed(baseline, 0)} mm apart on either side of the "
            "block, and the pixel axes are square to 1 degree; read literally they are not. "
            "Projecting the 27 calibration points with both readings shows what the doubt is worth:"
        ),
        *markdown(["reading", "RMS shift, px", "largest shift, px"], apart),
        (
            "The image coordinates are not printed, so neither reading can be tested against "
            "measurements. The principal points lie thousands of pixels outside of a 510 x 492 px "
            "image: a block of 12.7 mm at 0.6 m is seen almost in parallel projection, and eleven "
            "free parameters describe that without being a lens and a sensor. Such numbers predict "
            "well inside the block; **they are not focal lengths or principal points**, and this "
            "program does not present them so."
        ),
        "",
    ]


def _camera_row(name: str, camera: Decomposed) -> list[str]:
    centre = ", ".join(fixed(value, 1) for value in camera.centre_mm)
    principal = ", ".join(fixed(value, 0) for value in camera.principal_px)
    return [
        name,
        centre,
        fixed(camera.fx_px, 0),
        fixed(camera.fy_px, 0),
        fixed(camera.skew_deg, 2),
        principal,
    ]
