"""Profiles: what a lab declares about its files: columns, units and the conditions that the files do not state."""
