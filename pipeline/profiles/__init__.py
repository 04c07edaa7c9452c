"""Profiles, in which a lab declares the columns and units of its files, and the conditions that the files do not
state."""
