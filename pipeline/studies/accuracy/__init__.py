"""Error against run time of every method of theory."""
