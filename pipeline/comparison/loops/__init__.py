"""The loop that an experiment's logs allow to speak of: its parameters, whether it is adequate, and what follows."""
