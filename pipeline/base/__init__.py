"""Errors, units, atomic files, hashes, processes and compiled functions, used by all other folders."""
