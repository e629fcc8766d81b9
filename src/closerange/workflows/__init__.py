"""The verbs: detect, calibrate, measure, verify, run, demo, report."""
