"""Scores for theory's prediction of an experiment."""
