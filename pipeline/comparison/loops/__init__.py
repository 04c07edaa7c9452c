"""The identified loop of an experiment: its parameters, whether it is adequate, and the conclusions from it."""
