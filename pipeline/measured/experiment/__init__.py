"""Joint evaluation of the trials of an experiment: estimates with intervals, boundary, optima, and stored stages."""
