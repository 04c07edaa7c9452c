"""Estimates, verdicts and costs from logs alone, independent of theory."""
