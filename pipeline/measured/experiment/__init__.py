"""Evaluate the trials of an experiment jointly for estimates with intervals, boundary, optima, and stored stages."""
