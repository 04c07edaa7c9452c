"""Compute, store and reuse the stages of an experiment, i.e. its measured results."""
