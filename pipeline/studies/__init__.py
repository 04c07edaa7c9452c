"""Studies by the package of itself: the tables of the thesis anew, and error against run time."""
