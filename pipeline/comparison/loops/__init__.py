"""Parameters and adequacy of the identified loop of an experiment, and the conclusions from this loop."""
