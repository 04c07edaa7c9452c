"""Evaluate the trials of an experiment jointly: estimates with intervals, the boundary, optima, and stored stages."""
