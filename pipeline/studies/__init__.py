"""Studies of the package itself: recomputed tables of the thesis, and error against run time."""
