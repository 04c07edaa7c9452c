"""The public Python interface of ``import pipeline``. Tables of results are data frames in SI units."""
