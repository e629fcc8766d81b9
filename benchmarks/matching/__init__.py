"""Matching measured beside rivals: scenes with exact truth, methods, figures."""
