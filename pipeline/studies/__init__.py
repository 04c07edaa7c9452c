"""Studies by the package of itself: the tables of the thesis recomputed, and error against run time."""
