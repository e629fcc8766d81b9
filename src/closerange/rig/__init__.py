"""Cameras calibrated to one world frame: models, solutions, the rig and its file."""
