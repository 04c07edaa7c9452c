"""The identified loop of an experiment: its parameters, its adequacy, and the conclusions from it."""
