"""Pixels become points: targets, thresholds, borders, disc centres, labels."""
