"""Studies of the package itself: the tables of the thesis recomputed, and error against run time."""
