"""Image points of several cameras become world points, with covariance."""

from closerange.position.measure import measure_points
from closerange.position.positions import Positions
from closerange.position.positions_table import read_positions, write_positions
from closerange.position.triangulate import solve_points, triangulate_linear

__all__ = [
    "Positions",
    "measure_points",
    "read_positions",
    "solve_points",
    "triangulate_linear",
    "write_positions",
]
