"""Estimates, verdicts and costs that are computed only from logs, independently of theory."""
