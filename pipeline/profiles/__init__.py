"""Profiles, in which a lab declares the columns and units of its files, and conditions that the files do not state."""
