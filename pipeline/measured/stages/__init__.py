"""Stored results of an experiment: measurements of each stage, table of the stages, storage and reuse."""
