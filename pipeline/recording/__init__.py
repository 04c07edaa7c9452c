"""Checks of a recorded log, made before anything is computed from it."""
