"""Checks of a recorded log before it is used in a computation."""
