"""Estimates, verdicts and costs from logs alone; it knows nothing of theory."""
