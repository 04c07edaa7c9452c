"""Error against run time of every numerical method: of theory, and of the measured branch on simulated data."""
