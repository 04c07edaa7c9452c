"""Devices as data: their files, the values published for them, the human arm."""
