"""Results leave: reports, figures, tables."""

from closerange.delivery.overlays import Overlay, make_overlay
from closerange.delivery.report import render_report

__all__ = ["Overlay", "make_overlay", "render_report"]
