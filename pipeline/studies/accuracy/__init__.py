"""Error against run time of every numerical method, for theory and for measurements of simulated data."""
