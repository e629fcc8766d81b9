"""Comparison with a known truth: synthetic scenes, predicted error, acceptance tests."""
