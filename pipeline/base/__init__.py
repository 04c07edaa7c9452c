"""Errors, units, atomic files, hashes, processes and compiled functions, for all other folders."""
