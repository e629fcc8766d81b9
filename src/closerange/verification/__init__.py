"""Comparison with a known truth: synthetic scenes, bounds, acceptance tests."""
