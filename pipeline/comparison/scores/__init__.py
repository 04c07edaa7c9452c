"""Scores of theory's predictions of an experiment."""
