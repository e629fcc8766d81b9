"""Rendered scenes with exact truth, defined by code: solids, cameras, sensor, ray casting."""
