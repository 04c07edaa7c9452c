"""Error against run time of the measured branch, on simulated truth."""
