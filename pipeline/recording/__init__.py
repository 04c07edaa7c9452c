"""One check of a recorded log, before anything is computed from it."""
