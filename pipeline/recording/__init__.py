"""Checks of a recorded log, before the log is used in a computation."""
