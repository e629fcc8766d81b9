"""Results leave: reports, figures, tables."""

from closerange.delivery.overlays import Overlay, make_overlay
from closerange.delivery.report import render_report
from closerange.delivery.summary import json_summary, text_summary

__all__ = ["Overlay", "json_summary", "make_overlay", "render_report", "text_summary"]
