"""Studies of the package, namely recomputed tables of the thesis, and error versus run time of its methods."""
