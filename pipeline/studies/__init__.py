"""Studies of the package: recomputed tables of the thesis, and error against run time of its methods."""
