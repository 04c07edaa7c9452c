"""Damaged stored files: found, and all saved that can be read."""
