"""The verbs: detect, calibrate, volume, match, measure, verify, run, demo, report, shapes."""
