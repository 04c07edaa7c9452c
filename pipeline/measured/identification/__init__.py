"""Identification of an experiment: one model, one likelihood, one interval; from arrays of logs to an identified
device."""
