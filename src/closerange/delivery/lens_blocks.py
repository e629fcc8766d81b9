"""Radial distortion as a curve and a table: what the coefficients of a lens come to in pixels."""

from __future__ import annotations

import numpy as np

from closerange.delivery.plots import Panel, panel_grid
from closerange.delivery.sheet import Block, Figure, Paragraph, Table
from closerange.delivery.wording import DASH, counted, fixed
from closerange.geometry.arrays import FloatArray
from closerange.rig.camera import Camera
from closerange.rig.radial_table import RadialTable, radial_tables

ROWS = 10
"""About so many rows: between them the curve is smooth."""

_TEXT = (
    "Radial distortion of the lenses in pixels: an observed point at the distance r from its "
    "lens' centre lies by dr too far out, and x (1 - dr / r) is where it would be without "
    "distortion (x counts from that centre). So dr is subtracted; programs whose coefficients act "
    "on observed points add their corrections and have the opposite sign. Decentring is not in it."
)


def lens_blocks(cameras: tuple[Camera, ...]) -> list[Block]:
    """Draw and tabulate the radial distortion of cameras.

    Parameters
    ----------
    cameras : tuple of Camera
        Of one rig.

    Returns
    -------
    list of Block
        Empty if no lens distorts radially.
    """
    tables = radial_tables(cameras)
    if not tables:
        return []
    return [Paragraph(_TEXT), _curves(tables), _table(tables)]


def _curves(tables: dict[str, RadialTable]) -> Figure:
    panels = [
        Panel(
            x=table.radius_px,
            y=table.delta_px,
            x_label="distance r from the lens' centre [px]",
            y_label="dr [px]",
            title=f"Camera {name}",
            mark="chain",
            zero=True,
        )
        for name, table in tables.items()
    ]
    title = f"Radial distortion of {counted(len(tables), 'camera')}"
    columns = min(len(panels), 3)
    picture = panel_grid(panels, columns=columns, height=150, title=title, description=_TEXT)
    return Figure(picture, f"{title}: displacement dr of observed points, outwards positive.")


def _table(tables: dict[str, RadialTable]) -> Table:
    radii = _round_radii(max(float(table.radius_px[-1]) for table in tables.values()))
    columns = [table.delta(radii) for table in tables.values()]
    rows = [
        (fixed(radius, 0), *(fixed(d, 3) if np.isfinite(d) else DASH for d in deltas))
        for radius, *deltas in np.column_stack([radii, *columns]).tolist()
    ]
    head = ("r [px]", *(f"dr of {name} [px]" for name in tables))
    caption = f"Radial distortion, up to the farthest corner of the image ({DASH}: outside of it)"
    return Table(caption, head, rows, texts=frozenset())


def _round_radii(reach_px: float) -> FloatArray:
    """Return about `ROWS` radii at a round step."""
    power = 10.0 ** np.floor(np.log10(reach_px / ROWS))
    step = next(m * power for m in (1, 2, 5, 10) if reach_px / (m * power) <= ROWS)
    return np.arange(0.0, reach_px + 1e-9, step)
