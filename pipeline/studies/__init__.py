"""Studies of the package: recomputed tables of the thesis, and error versus run time of the package's methods."""
